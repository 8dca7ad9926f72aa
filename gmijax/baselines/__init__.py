"""What the paper has and only comparisons with it need; chosen by name, imported when chosen."""
