"""The controller: plans, starts and watches jobs, searches, reports what there is."""
