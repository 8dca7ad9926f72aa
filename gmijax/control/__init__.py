"""The controller: plans, starts and watches jobs, searches, tells what there is."""
