"""Everything that `python -m gmijax.export` can be told."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from gmijax.config.play import PlayRunConfig
from gmijax.config.schema import KeyGroup, doc


@dataclass(frozen=True, kw_only=True)
class ExportConfig(KeyGroup):
    """Everything that `python -m gmijax.export` can be told."""

    run: PlayRunConfig
    checkpoint: str | None = doc(
        "folder of a checkpoint, its env steps, or `best`; null: the latest"
    )
    format: Literal["onnx", "stablehlo", "all"] = doc(
        "what to write: onnx for ONNX Runtime and others, stablehlo for jax.export, or all"
    )
