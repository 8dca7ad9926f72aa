"""What is found on a host: GPUs, MPS, limits, processes."""
