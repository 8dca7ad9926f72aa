"""Benchmarks: cases as data (`cases`), a runner (`python -m benchmarks.run`), and their results.

All benchmarks run their commands by `runner` and write by `records`; `python -m benchmarks` keeps
the documents equal to the files.
"""
