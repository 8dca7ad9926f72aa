"""A tree of arrays in a folder, written by orbax: devices, random keys and odd paths left out."""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
import orbax.checkpoint as ocp

from gmijax.errors import ConfigError, GmijaxError, lines_of
from gmijax.runs.names import nearby
from gmijax.types import PyTree

T = TypeVar("T")

_LEARNING, _KEPT = "live.", "params."
"""Of SAC, the policy that learns and its average: one and the same in older checkpoints."""


def save(folder: Path, tree: PyTree) -> None:
    """Writes a tree of arrays; random keys as plain numbers.

    Raises:
      GmijaxError: it cannot be read again.
    """
    # A checkpoint has nothing of devices.
    plain = jax.tree.map(np.asarray, _storable(tree))
    with _plain_path(folder) as path, ocp.StandardCheckpointer() as checkpointer:
        checkpointer.save(path, plain)
    if _difference(saved_shapes(folder), _shapes(plain)) is not None:
        raise GmijaxError(
            f"checkpoint {nearby(folder)}: cannot be read again after it was written"
        )


def restore(folder: Path, template: T) -> T:
    """Reads a tree of arrays; `template` gives structure, shapes and dtypes, or is these alone.

    Arrays are found by their names, so that a field which is None here may be unknown there.

    Raises:
      ConfigError: what is there does not fit the template.
    """
    try:
        with _plain_path(folder) as path, ocp.StandardCheckpointer() as checkpointer:
            saved = _by_name(checkpointer.restore(path))
    except Exception as error:
        # Orbax raises a plain `Exception` for an array that it cannot read. Anything else, such
        # as a device without enough memory, does not show that the checkpoint is bad.
        if not isinstance(error, ValueError | KeyError | OSError) and type(error) is not Exception:
            raise
        why = lines_of(error)[0]
        raise ConfigError(f"checkpoint {nearby(folder)} does not fit this job: {why}") from error
    wanted = _shapes(jax.eval_shape(_storable, template))
    for name in wanted.keys() - saved.keys():
        kept = _KEPT + name.removeprefix(_LEARNING)
        if name.startswith(_LEARNING) and kept in saved:
            saved[name] = saved[kept]
    if why := _difference(_shapes(saved), wanted):
        raise ConfigError(f"checkpoint {nearby(folder)} does not fit this job: {why}")
    return jax.tree.map_with_path(lambda path, like: _restored(like, saved[_name(path)]), template)


def saved_shapes(folder: Path) -> dict[str, tuple[int, ...]]:
    """Shapes of all saved arrays by their dotted names; none if nothing can be read."""
    try:
        with _plain_path(folder) as path, ocp.StandardCheckpointer() as checkpointer:
            saved: Any = checkpointer.metadata(path).item_metadata
        return _shapes(saved.tree)
    except (AttributeError, OSError, TypeError, ValueError):
        return {}


def on_host(tree: T) -> T:
    """A copy in the host's memory; random keys are plain arrays there."""
    return jax.tree.map(lambda leaf: np.array(_without_key(leaf)), tree)


def size_bytes(tree: PyTree) -> int:
    """What arrays, or their shapes and dtypes, take in memory."""
    return sum(leaf.size * leaf.dtype.itemsize for leaf in jax.tree.leaves(tree))


@contextmanager
def _plain_path(folder: Path) -> Iterator[Path]:
    """A path of a folder, which need not be there yet, without any but plain characters.

    Orbax looks for its own files by patterns that begin with the whole path, so brackets in it
    hide them; TensorStore takes a backslash for a slash, and `gs:/` for a scheme.
    """
    parent = os.open(folder.parent, os.O_PATH | os.O_DIRECTORY | os.O_CLOEXEC)
    try:
        yield Path(f"/proc/self/fd/{parent}") / folder.name
    finally:
        os.close(parent)


def _difference(
    saved: Mapping[str, tuple[int, ...]], wanted: Mapping[str, tuple[int, ...]]
) -> str | None:
    """The first array in which a checkpoint differs; None if none does."""
    for name in sorted(saved.keys() | wanted.keys()):
        if name not in wanted:
            return f"it has {name}, this job has not"
        if name not in saved:
            return f"it has no {name}, this job has"
        if saved[name] != wanted[name]:
            return f"its {name} is {list(saved[name])}, that of this job {list(wanted[name])}"
    return None


def _shapes(tree: PyTree) -> dict[str, tuple[int, ...]]:
    return {name: leaf.shape for name, leaf in _by_name(tree).items()}


def _by_name(tree: PyTree) -> dict[str, Any]:
    """All arrays of a tree by their dotted names."""
    return {_name(path): leaf for path, leaf in jax.tree.leaves_with_path(tree)}


def _name(path: tuple[Any, ...]) -> str:
    return jax.tree_util.keystr(path, simple=True, separator=".")


def _is_key(leaf: jax.Array) -> bool:
    return jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key)


def _storable(tree: T) -> T:
    # Orbax takes neither typed random keys, whose bits are plain uint32 arrays, nor arrays
    # without elements, such as the activations of a model that has none.
    def plain(leaf: jax.Array) -> Any:
        return np.zeros(1, np.float32) if leaf.size == 0 else _without_key(leaf)

    return jax.tree.map(plain, tree)


def _without_key(leaf: jax.Array) -> jax.Array:
    return jax.random.key_data(leaf) if _is_key(leaf) else leaf


def _restored(like: jax.Array, leaf: np.ndarray) -> jax.Array:
    if like.size == 0:
        return jnp.zeros(like.shape, like.dtype)
    if _is_key(like):
        return jax.random.wrap_key_data(jnp.array(leaf))
    return jnp.array(leaf.astype(like.dtype))
