"""SAC with many environments and large batches (FastSAC, arXiv:2512.01996)."""
