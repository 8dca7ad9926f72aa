"""Meshes of four points in place of MuJoCo Menagerie's, for tasks of MuJoCo Playground.

Their meshes are only looked at: nothing collides with them, and no mass comes from them.
"""

from __future__ import annotations

import importlib.util
import struct
import xml.etree.ElementTree as ElementTree
from itertools import combinations
from pathlib import Path

from gmijax.sim.robot_models import models_of

_POINTS = ((0.0, 0.0, 0.0), (0.1, 0.0, 0.0), (0.0, 0.1, 0.0), (0.0, 0.0, 0.1))
_STL = struct.pack("<80xI", 4) + b"".join(
    struct.pack("<12f2x", 0.0, 0.0, 0.0, *a, *b, *c) for a, b, c in combinations(_POINTS, 3)
)
_OBJ = "\n".join(
    [f"v {x} {y} {z}" for x, y, z in _POINTS]
    + [f"f {a + 1} {b + 1} {c + 1}" for a, b, c in combinations(range(4), 3)]
).encode()


def make_stand_ins(root: Path, task: str, robot: str) -> None:
    """Writes the models that a `task` of Playground needs into `root`, as `MENAGERIE_ROOT` has it.

    `robot` is the folder of the task in Playground's locomotion suite.
    """
    spec = importlib.util.find_spec("mujoco_playground")
    assert spec is not None
    assert spec.origin is not None
    xmls = Path(spec.origin).parent / "_src" / "locomotion" / robot / "xmls"
    own = {path.name for path in xmls.rglob("*")}
    for model in models_of(task):
        assets = root / model / "assets"
        assets.mkdir(parents=True)
        for xml in xmls.glob("*.xml"):
            for mesh in ElementTree.parse(xml).iter("mesh"):
                name = Path(mesh.get("file", "")).name
                if name and name not in own:
                    (assets / name).write_bytes(_STL if name.lower().endswith("stl") else _OBJ)
