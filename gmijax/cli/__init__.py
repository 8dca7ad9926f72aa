"""Command lines: overrides to configuration, `--help`, exit codes."""
