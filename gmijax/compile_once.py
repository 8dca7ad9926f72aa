"""Compiles a program once for all processes with the same compilation cache."""

from __future__ import annotations

import hashlib
import os
import re
from pathlib import Path
from typing import Any, Final

import jax
from jax.stages import Compiled, Lowered

from gmijax.runs.compile_lock import compile_alone
from gmijax.version import versions_of

_NAME: Final = re.compile(r"module @([\w.<>-]+)")


def compile_once(lowered: Lowered) -> Compiled:
    """`lowered.compile()`, which waits while another process compiles the same program.

    Without a compilation cache in a folder there is nothing to wait for.
    """
    settings: Any = jax.config
    cache = settings.jax_compilation_cache_dir
    if not cache or "://" in cache or not settings.jax_enable_compilation_cache:
        return lowered.compile()
    text, device = lowered.as_text(), jax.local_devices()[0]
    # As jax names an entry of the cache: programs that differ in one of these have one each.
    parts = [repr(versions_of(("jax", "jaxlib"))), device.client.platform_version]
    parts += [device.device_kind, os.environ.get("XLA_FLAGS", ""), text]
    key = hashlib.sha256("\n".join(parts).encode()).hexdigest()
    found = _NAME.search(text)
    return compile_alone(Path(cache), found[1] if found else "program", key, lowered.compile)
