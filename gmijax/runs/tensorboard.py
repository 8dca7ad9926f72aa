"""What is used of tensorboardX, imported without PyTorch.

tensorboardX imports PyTorch wherever it is installed, only to recognise tensors. That adds seconds
to every start and memory to every GMI.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any


@contextmanager
def _without(package: str) -> Iterator[None]:
    """An import of the package fails inside; one that is there already stays."""
    if package in sys.modules:
        yield
        return
    sys.modules[package] = None  # type: ignore[assignment]
    try:
        yield
    finally:
        del sys.modules[package]


with _without("torch"):
    from tensorboardX.event_file_writer import EventsWriter
    from tensorboardX.proto import event_pb2, summary_pb2
    from tensorboardX.summary import hparams, scalar

# Made by protobuf at run time: type checkers cannot see them.
Event: Any = vars(event_pb2)["Event"]
Summary: Any = vars(summary_pb2)["Summary"]

__all__ = ["Event", "EventsWriter", "Summary", "hparams", "scalar"]
