"""Benchmarks: cases as data (`cases`), one runner (`python -m benchmarks.run`)."""
