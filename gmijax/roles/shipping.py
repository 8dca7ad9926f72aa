"""Roles and what they return, as pickles that cross from one fresh interpreter to another.

A class travels by name, so the GMI must be able to load the module that holds it. For a script
that is run (`__main__`) it loads the same file under another name; the part below
`if __name__ == "__main__":` does not run there.
"""

from __future__ import annotations

import importlib
import importlib.util
import io
import os
import pickle
import sys
from collections.abc import Mapping
from pathlib import Path
from types import ModuleType
from typing import Any, Final

from gmijax.channels.trees import on_host
from gmijax.errors import ConfigError

MAIN: Final = "__main__"
LOADED_MAIN: Final = "__gmijax_main__"
"""Name of the user's script in a GMI."""


def dump(value: Any) -> bytes:
    """Pickles `value`; arrays of jax become arrays of numpy.

    Raises:
      TypeError, AttributeError, pickle.PicklingError: something cannot be pickled.
    """
    file = io.BytesIO()
    _Pickler(file, protocol=5).dump(value)
    return file.getvalue()


def load(data: bytes, script: Mapping[str, Any] | None = None) -> Any:
    """Inverts `dump`.

    Args:
      data: of a process of the same job: unpickling runs code.
      script: in a GMI, what `own_script` gave where the job was started.
    """
    return _Unpickler(io.BytesIO(data), script).load()


def own_script() -> dict[str, Any]:
    """How a GMI finds what this process has: plain data for `load`, with `sys.path`."""
    main = sys.modules[MAIN]
    spec = getattr(main, "__spec__", None)
    file = getattr(main, "__file__", None)
    return {
        # Started by `python -m`: then it is importable, and its relative imports need it to be.
        # A folder or an archive that is run has a spec too, but no name to import it by.
        "module": spec.name if spec is not None and spec.name != MAIN else None,
        "file": os.path.abspath(file) if file and Path(file).is_file() else None,
        "sys_path": [os.path.abspath(entry) for entry in sys.path],
    }


def require_findable(role: type) -> None:
    """Raises ConfigError unless a GMI can find the class `role` by name."""
    name, script = role.__qualname__, own_script()
    if "<locals>" in name:
        raise ConfigError(
            f"role={name}: inside of a function; GMIs find a class by name, so write it at the "
            "top level of a file"
        )
    if role.__module__ == MAIN and not (script["module"] or script["file"]):
        raise ConfigError(
            f"role={name}: not in a file; GMIs are processes of their own, so write the class "
            "into a file and import it"
        )


class _Pickler(pickle.Pickler):
    def reducer_override(self, obj: Any) -> Any:
        if type(obj).__module__.partition(".")[0] not in ("jax", "jaxlib"):
            return NotImplemented
        array = on_host(obj)
        return NotImplemented if array is None else array.__reduce_ex__(5)


class _Unpickler(pickle.Unpickler):
    def __init__(self, file: io.BytesIO, script: Mapping[str, Any] | None) -> None:
        super().__init__(file)
        self._script = script

    def find_class(self, module_name: str, global_name: str, /) -> Any:
        if module_name == MAIN and self._script is not None:
            module_name = _load_main(self._script).__name__
        elif module_name == (own_script()["module"] or LOADED_MAIN) and self._script is None:
            # What a GMI returns: there, this very script has another name.
            module_name = MAIN
        return super().find_class(module_name, global_name)


def _load_main(script: Mapping[str, Any]) -> ModuleType:
    if script["module"]:
        return importlib.import_module(script["module"])
    if LOADED_MAIN in sys.modules:
        return sys.modules[LOADED_MAIN]
    spec = importlib.util.spec_from_file_location(LOADED_MAIN, script["file"])
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[LOADED_MAIN] = module
    spec.loader.exec_module(module)
    return module
