# gmijax for NVIDIA GPUs, driver 580 or newer; for older ones `--build-arg EXTRAS=cuda12,warp`, without
# a GPU `--build-arg EXTRAS=brax`. How to run it, and MPS in it: docs/containers.md.
FROM python:3.12-slim

ARG EXTRAS=cuda13,warp

# CUDA comes from the package index, the driver and nvidia-cuda-mps-control from the host by the
# NVIDIA Container Toolkit: `compute` for both, `utility` for NVML, `graphics` for filming with EGL.
ENV NVIDIA_VISIBLE_DEVICES=all \
    NVIDIA_DRIVER_CAPABILITIES=compute,utility,graphics

RUN apt-get update \
    && apt-get install -y --no-install-recommends git libegl1 libosmesa6 \
    && rm -rf /var/lib/apt/lists/*

WORKDIR /opt/gmijax
COPY pyproject.toml README.md LICENSE ./
COPY .ci/package_page.py .ci/
COPY gmijax gmijax
COPY configs configs
RUN pip install --no-cache-dir ".[${EXTRAS}]"

# Run folders go to ./runs: mount a folder here to keep them.
WORKDIR /work
ENTRYPOINT ["gmijax"]
CMD ["--help"]
