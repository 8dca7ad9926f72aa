"""What is damaged between two commands in a run folder or a cache, and what is put there."""

from __future__ import annotations

import json
import os
import random
import shutil
from pathlib import Path

from fault_checks import checkpoints_of, is_whole

_COPIES = ("2099-11-26-good", "{}.mine", "9{}", "{} (1)", "\u0660" * 12)
"""Names of copies, after that of the checkpoint: by hand, by a file manager, in other digits."""


def damage_checkpoint(run: Path, kind: str) -> None:
    """Damages the newest whole checkpoint, as its kind of fault says.

    Not the only one: a run without a whole one is refused.
    """
    whole = [path for path in checkpoints_of(run) if is_whole(path)]
    if len(whole) < 2:
        return
    checkpoint = whole[-1]
    meta = checkpoint / "meta.json"
    files = [path for path in checkpoint.rglob("*") if path.is_file() and path != meta]
    largest = max(files, key=lambda path: path.stat().st_size)
    if kind == "checkpoint_meta":
        os.truncate(meta, 0)
    elif kind == "checkpoint_truncated":
        os.truncate(largest, largest.stat().st_size // 2)
    elif kind == "checkpoint_fifo":
        largest.unlink()
        os.mkfifo(largest)
    elif kind == "checkpoint_device":
        noted = json.loads(meta.read_text())
        noted["files"] |= {"/dev/zero": [1, 1], "../../../device": [1, 1]}
        meta.write_text(json.dumps(noted))
    else:
        data = bytearray(largest.read_bytes())
        data[len(data) // 2] ^= 1
        largest.write_bytes(data)


def add_copies(run: Path) -> set[str]:
    """Copies of the oldest checkpoint beside the others; returns their names."""
    oldest, *_ = checkpoints_of(run)
    names = {name.format(oldest.name) for name in _COPIES}
    for name in names:
        shutil.copytree(oldest, oldest.with_name(name), dirs_exist_ok=True)
    return names


def copies_in(run: Path) -> set[str]:
    """Names of what lies among the checkpoints and is none."""
    own = {path.name for path in checkpoints_of(run)}
    return {path.parent.name for path in run.glob("checkpoints/*/meta.json")} - own


def damage_entries(cache: Path, kind: str, draw: random.Random) -> None:
    """Cuts compiled programs in half, or flips bits in them."""
    for entry in cache.glob("*-cache"):
        if kind == "cache_truncated":
            os.truncate(entry, entry.stat().st_size // 2)
        else:
            data = bytearray(entry.read_bytes())
            for _ in range(8):
                data[draw.randrange(len(data))] ^= 1 << draw.randrange(8)
            entry.write_bytes(data)
