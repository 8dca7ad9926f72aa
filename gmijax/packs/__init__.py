"""Any command as a job: its command line, and what it prints of its progress."""
