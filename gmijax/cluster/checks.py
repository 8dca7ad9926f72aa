"""What is asked of all nodes before anything is started: equal versions, a folder that all see."""

from __future__ import annotations

import os
import secrets
import tempfile
import time
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path

from gmijax.clock import running_s
from gmijax.cluster.node import COMPARED, ON_GPUS, Facts
from gmijax.cluster.ray_nodes import NodeHandle
from gmijax.errors import ConfigError
from gmijax.machine.differences import differences_in
from gmijax.machine.snapshot import Machine
from gmijax.runs.names import nearby
from gmijax.version import versions_of

SHOWS_S = 20.0
"""Network file systems show what others have written late, some after seconds."""

_POLL_S = 0.2


def by_name(joined: Sequence[NodeHandle]) -> dict[str, NodeHandle]:
    """Nodes by address, in order; those after the first of a machine have their number added."""
    named: dict[str, NodeHandle] = {}
    for number, node in enumerate(joined):
        address = node.remote.address
        named[f"{address}#{number}" if address in named else address] = node
    return named


def differences_in_versions(nodes: Mapping[str, Facts]) -> list[str]:
    """In what versions they differ, in sentences; packages for GPUs count where there are some."""
    packages = dict.fromkeys(what for facts in nodes.values() for what in facts.versions)
    found: list[str] = []
    for what in packages:
        asked = {n: f for n, f in nodes.items() if what not in ON_GPUS or f.machine.gpus}
        found += differences_in(what, {n: f.versions.get(what) for n, f in asked.items()})
    return found


def require_alike(joined: Sequence[NodeHandle]) -> None:
    """Raises ConfigError if nodes differ in versions from this machine, or for GPUs in between."""
    # This machine may have no GPUs: it does not use them.
    here = Facts("", Machine((), ()), versions_of(COMPARED))
    nodes = {name: node.facts for name, node in by_name(joined).items()}
    if problems := differences_in_versions({"this machine": here, **nodes}):
        raise ConfigError(f"cluster.engine=ray: {problems[0]}; all nodes must have the same")


def require_shared(joined: Sequence[NodeHandle], run_root: Path) -> None:
    """Raises ConfigError if a node does not see the run folder, or what will hold it."""
    shown = f"run.dir={nearby(run_root)}"
    folder = run_root.absolute()
    while not folder.is_dir():
        folder = folder.parent
    content = secrets.token_hex(8)
    try:
        fd, name = tempfile.mkstemp(prefix=".gmijax-probe-", dir=folder)
    except OSError as error:
        raise ConfigError(f"{shown}: {folder}: {error.strerror}") from None
    try:
        with os.fdopen(fd, "w") as file:
            file.write(content)
        deadline_s = running_s() + SHOWS_S
        blind = [node for node, _ in joined]
        while blind := [node for node in blind if not node.call("sees", name, content)]:
            if running_s() > deadline_s or any(node.lost for node in blind):
                raise ConfigError(
                    f"{shown}: node {blind[0].address} does not see {folder} or "
                    "cannot write to it; the run folder must be on a file system that all "
                    "nodes share"
                )
            time.sleep(_POLL_S)
    finally:
        with suppress(OSError):
            Path(name).unlink()
