"""Files that end with a digest of what is before it. No jax here.

What `jax.export` writes is a program: with a few other bits it crashes the process that takes it
in. `jax.export.deserialize` itself passes over what stands behind the program.
"""

from __future__ import annotations

import hashlib
from typing import Final

_MARK: Final = b"\ngmijax sha256 "
_DIGITS: Final = 64


def sealed(content: bytes) -> bytes:
    """The content with its digest behind it."""
    return content + _MARK + hashlib.sha256(content).hexdigest().encode()


def unsealed(data: bytes) -> bytes:
    """The content of what `sealed` made.

    Raises:
      ValueError: it has no digest, or another one.
    """
    content, mark, digest = data[-len(_MARK) - _DIGITS :].partition(_MARK)
    before = data[: -len(_MARK) - _DIGITS]
    if content or not mark or len(digest) != _DIGITS:
        raise ValueError("no digest at its end: cut off, or written by an older version")
    if digest != hashlib.sha256(before).hexdigest().encode():
        raise ValueError("not as it was written: its SHA-256 is another one")
    return before
