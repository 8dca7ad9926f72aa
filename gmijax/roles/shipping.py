"""Roles and what they return, as pickles that cross from one fresh interpreter to another.

A class travels by the name of its module; one of a script (`__main__`), a notebook or a function
travels itself, with what it uses.
"""

from __future__ import annotations

import io
from typing import Any

import cloudpickle

from gmijax.channels.trees import on_host


def dump(value: Any) -> bytes:
    """Pickles `value` for `pickle.loads`; arrays of jax become arrays of numpy.

    Raises:
      TypeError, pickle.PicklingError: something cannot be pickled.
    """
    file = io.BytesIO()
    _RolePickler(file).dump(value)
    return file.getvalue()


class _RolePickler(cloudpickle.Pickler):
    def reducer_override(self, obj: Any) -> Any:
        if type(obj).__module__.partition(".")[0] in ("jax", "jaxlib"):
            array = on_host(obj)
            if array is not None:
                return array.__reduce_ex__(5)
        return super().reducer_override(obj)
