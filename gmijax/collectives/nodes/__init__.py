"""Exchange between the nodes of a job."""
