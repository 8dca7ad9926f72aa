"""The documents tell the truth about the files of the checkout and the terms of the rewards."""

from __future__ import annotations

import ast
import dataclasses
import importlib
import re
from collections.abc import Mapping
from pathlib import Path

import pytest

from gmijax.sim.registry import TASKS
from gmijax.sim.tasks.settings import SETTINGS

ROOT = Path(__file__).parents[2]
PACKAGE = ROOT / "gmijax"
ARCHITECTURE = ROOT / "docs" / "architecture.md"
MAX_LINES = 250
TASKS_PAGE = ROOT / "docs" / "tasks.md"
FOLDERS = ("gmijax", "configs", "tests", "docs", "benchmarks", "examples", ".ci")

QUOTED_PATH = re.compile(rf"`((?:{'|'.join(map(re.escape, FOLDERS))})/[\w./-]*)`")
LINK = re.compile(r"!?\[[^\]]*\]\(([^)\s]+)\)")
OBS_ROW = re.compile(r"^\| (\d+)(?:-(\d+))? \|", re.MULTILINE)
NUMBER_ROW = re.compile(r"^\| `(\w+)` \| (.*) \| (-?[\d.]+) \|$", re.MULTILINE)


def documents() -> list[Path]:
    alone = [path for name in ("README.md", "CONTRIBUTING.md") if (path := ROOT / name).is_file()]
    return [*alone, *sorted((ROOT / "docs").rglob("*.md"))]


def linked_paths(text: str) -> list[str]:
    """Targets of the links of a document that are paths, without the part behind `#`."""
    prose = re.sub(r"```.*?```", "", text, flags=re.DOTALL)
    targets = [target.partition("#")[0] for target in LINK.findall(prose)]
    return [target for target in targets if target and not re.match(r"[a-z]+:", target)]


def part_of_task(task: str, heading: str) -> str:
    """What stands under a heading in the section of a task."""
    sections = re.split(r"^## ", TASKS_PAGE.read_text(), flags=re.MULTILINE)
    section = next(text for text in sections if text.startswith(f"`{task}`"))
    return re.split(rf"^### {heading}$", section, flags=re.MULTILINE)[1].partition("\n### ")[0]


def documented_weights(task: str) -> Mapping[str, float]:
    """The table of rewards in the section of a task."""
    rows = NUMBER_ROW.findall(part_of_task(task, "Reward"))
    return {name: float(weight) for name, _, weight in rows}


def documented_lengths(task: str) -> list[int]:
    """How many values of an observation every row of the task's table is about."""
    table = part_of_task(task, "Observation")
    return [int(last or first) - int(first) + 1 for first, last in OBS_ROW.findall(table)]


def test_every_folder_of_the_package_is_in_the_architecture():
    quoted = set(QUOTED_PATH.findall(ARCHITECTURE.read_text()))
    files = [path for path in PACKAGE.rglob("*") if path.is_file()]
    folders = {path.parent for path in files if "__pycache__" not in path.parts} - {PACKAGE}
    names = sorted(f"{path.relative_to(ROOT).as_posix()}/" for path in folders)
    assert [name for name in names if name not in quoted] == []


def test_the_architecture_is_short():
    assert len(ARCHITECTURE.read_text().splitlines()) <= MAX_LINES


def test_every_module_of_the_package_says_what_it_is_for():
    modules = sorted(PACKAGE.rglob("*.py"))
    assert [path for path in modules if not ast.get_docstring(ast.parse(path.read_text()))] == []


@pytest.mark.parametrize("document", documents(), ids=lambda path: path.stem)
def test_paths_that_a_document_names_exist(document: Path):
    quoted = QUOTED_PATH.findall(document.read_text())
    assert [path for path in quoted if not (ROOT / path).exists()] == []


@pytest.mark.parametrize("document", documents(), ids=lambda path: path.stem)
def test_relative_links_point_somewhere(document: Path):
    linked = linked_paths(document.read_text())
    assert [path for path in linked if not (document.parent / path).exists()] == []


def test_only_relative_links_outside_of_code_are_looked_at():
    text = "[a](b.md#c) ![d](img/e.png) [f](https://g.org) [h](#i)\n```\n[j](k.md)\n```"
    assert linked_paths(text) == ["b.md", "img/e.png"]


@pytest.mark.parametrize("task", sorted(TASKS))
def test_reward_terms_and_weights_are_those_of_the_code(task: str):
    terms = importlib.import_module(TASKS[task]).TERMS
    assert documented_weights(task) == {name: term.weight for name, term in terms.items()}


@pytest.mark.parametrize("task", sorted(TASKS))
def test_parts_of_an_observation_are_those_of_the_table(task: str):
    module = importlib.import_module(TASKS[task])
    assert documented_lengths(task) == [length for _, length in module.OBS_TERMS]
    assert sum(length for _, length in module.OBS_TERMS) == module.OBS_SIZE


@pytest.mark.parametrize("task", sorted(TASKS))
def test_settings_are_those_of_the_code(task: str):
    documented = NUMBER_ROW.findall(part_of_task(task, "Settings"))
    settings = SETTINGS[task]()
    assert [(name, meaning, float(default)) for name, meaning, default in documented] == [
        (field.name, field.metadata["doc"], getattr(settings, field.name))
        for field in dataclasses.fields(settings)
    ]
