"""What is sent to Weights & Biases."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from gmijax.config.schema import KeyGroup, doc


@dataclass(frozen=True, kw_only=True)
class WandbConfig(KeyGroup):
    """Metrics, configuration and summary at Weights & Biases."""

    prefix = "wandb."

    mode: Literal["off", "online", "offline"] = doc(
        "send metrics to Weights & Biases; offline: keep them in the run folder for `wandb sync`",
        default="off",
    )
    project: str = doc("its project", default="gmijax")
    group: str | None = doc(
        "its group of runs; null: none, for jobs of a sweep the name of the sweep's folder",
        default=None,
    )
