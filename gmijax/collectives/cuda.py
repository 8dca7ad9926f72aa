"""What links between NVIDIA GPUs are made of."""

from __future__ import annotations

from gmijax.collectives.cuda_memory import CudaMemory
from gmijax.collectives.cuda_queue import CudaQueue
from gmijax.collectives.device_links import Device
from gmijax.collectives.nccl_ring import nccl_ring

CUDA = Device(CudaMemory, CudaQueue, nccl_ring)
