"""Small file systems of their own, for what must happen when they are full."""

from __future__ import annotations

import shutil
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from types import MappingProxyType

DISKS = MappingProxyType(
    {
        "small": ("disk", "size=96m"),
        "few_inodes": ("disk", "size=512m,nr_inodes=8k"),
        "cache": ("cache", "size=24m"),
        "cache_few_inodes": ("cache", "size=64m,nr_inodes=1k"),
    }
)
"""By name: which folder of a case, and options of its `tmpfs`."""


@cache
def can_mount() -> bool:
    """Whether this process may mount a file system of its own, and have commands do it."""
    if shutil.which("unshare") is None:
        return False
    tried = ["unshare", "-m", "mount", "-t", "tmpfs", "-o", "ro", "tmpfs", "/dev/shm"]
    return subprocess.run(tried, capture_output=True, check=False).returncode == 0


@contextmanager
def disk_of(disk: str, scratch: Path) -> Iterator[None]:
    """Makes the folder of a case the file system `disk` while it is entered."""
    if disk not in DISKS:
        yield
        return
    name, options = DISKS[disk]
    folder = scratch / name
    folder.mkdir(parents=True, exist_ok=True)
    subprocess.run(["mount", "-t", "tmpfs", "-o", options, "tmpfs", str(folder)], check=True)
    try:
        yield
    finally:
        subprocess.run(["umount", "--lazy", str(folder)], check=True)
