"""The documents, and `docs/pages.py`, which makes a site of them."""
