"""The documents agree with the files of the checkout and the terms of the rewards."""

from __future__ import annotations

import ast
import dataclasses
import importlib
import re
import tomllib
from collections.abc import Iterator, Mapping
from functools import partial
from pathlib import Path
from typing import Any

import pytest

import gmijax
from docs.pages import documents, link_documents, linked_paths
from docs.reference import COMMANDS, TOPICS, USAGES, command_page, python_page
from gmijax.__main__ import VERBS
from gmijax.cli.compose import defaults
from gmijax.cli.help import keys_of
from gmijax.sim.registry import TASKS
from gmijax.sim.tasks.settings import SETTINGS

ROOT = Path(__file__).parents[2]
PACKAGE = ROOT / "gmijax"
ARCHITECTURE = ROOT / "docs" / "architecture.md"
MAX_LINES = 250
TASKS_PAGE = ROOT / "docs" / "tasks.md"
FOLDERS = ("gmijax", "configs", "tests", "docs", "benchmarks", "examples", ".ci")

QUOTED_PATH = re.compile(rf"`((?:{'|'.join(map(re.escape, FOLDERS))})/[\w./-]*)`")
NAMES_BEHIND_PATH = re.compile(r"`([\w/]+\.py)` \(((?:`\w+`(?:, )?)+)\)")
NAME_IN_PATH = re.compile(r"`(\w+)` in `([\w/]+\.py)`")
OBS_ROW = re.compile(r"^\| (\d+)(?:-(\d+))? \|", re.MULTILINE)
FENCE = re.compile(r"^```.*?^```", re.DOTALL | re.MULTILINE)
ANCHOR_LINK = re.compile(r"\]\(([\w./-]*)#([^)\s]+)\)")
NUMBER_ROW = re.compile(r"^\| `(\w+)` \| (.*) \| (-?[\d.]+) \|$", re.MULTILINE)


def pages_of(navigation: list[dict[str, Any]]) -> Iterator[str]:
    """The pages that the navigation of the site names."""
    for entry in navigation:
        for value in entry.values():
            yield from [value] if isinstance(value, str) else pages_of(value)


def anchors_of(document: Path) -> set[str]:
    """The names by which GitHub and the site both know a heading."""
    headings = re.findall(r"^#+ (.+)$", FENCE.sub("", document.read_text()), flags=re.MULTILINE)
    on_github = {re.sub(r"[^\w -]", "", title.lower()).replace(" ", "-") for title in headings}
    return {name for name in on_github if "--" not in name}


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


@pytest.mark.parametrize("page", ["architecture.md", "extending.md"])
def test_a_name_that_a_page_puts_into_a_file_is_there(page: str):
    """Names in brackets behind a path, and `name` in `path`."""
    text = (ROOT / "docs" / page).read_text()
    pairs = [
        (path, name)
        for path, names in NAMES_BEHIND_PATH.findall(text)
        for name in re.findall(r"`(\w+)`", names)
    ] + [(path, name) for name, path in NAME_IN_PATH.findall(text)]
    assert len(pairs) > 3
    missing = [
        f"{name} in {path}"
        for path, name in pairs
        if not re.search(rf"\b{name}\b", (ROOT / path).read_text())
    ]
    assert missing == []


def test_the_architecture_is_short():
    assert len(ARCHITECTURE.read_text().splitlines()) <= MAX_LINES


def test_every_module_of_the_package_says_what_it_is_for():
    modules = sorted(PACKAGE.rglob("*.py"))
    assert [path for path in modules if not ast.get_docstring(ast.parse(path.read_text()))] == []


def test_the_site_shows_examples_as_code():
    # Below `Example:` mkdocstrings takes `>>>` for quotations.
    modules = sorted(PACKAGE.rglob("*.py"))
    assert [path for path in modules if re.search(r"^ *Example:\n", path.read_text(), re.M)] == []


@pytest.mark.parametrize("document", documents(), ids=lambda path: path.stem)
def test_paths_that_a_document_names_exist(document: Path):
    quoted = QUOTED_PATH.findall(document.read_text())
    assert [path for path in quoted if not (ROOT / path).exists()] == []


@pytest.mark.parametrize("document", documents(), ids=lambda path: path.stem)
def test_relative_links_point_somewhere(document: Path):
    linked = linked_paths(document.read_text())
    assert [path for path in linked if not (document.parent / path).exists()] == []


@pytest.mark.parametrize("document", documents(), ids=lambda path: path.stem)
def test_links_into_documents_name_a_heading(document: Path):
    links = ANCHOR_LINK.findall(FENCE.sub("", document.read_text()))
    targets = [(document.parent / path if path else document, name) for path, name in links]
    assert [f"{path}#{name}" for path, name in targets if name not in anchors_of(path)] == []


@pytest.mark.parametrize("document", documents(), ids=lambda path: path.stem)
def test_links_are_titled_by_what_they_lead_to(document: Path):
    # A file of results is its own title; a document has a heading.
    titles = re.findall(r"(?<!!)\[([^\]]*)\]\(", FENCE.sub("", document.read_text()))
    assert [title for title in titles if re.search(r"\.md\b", title)] == []


def test_only_relative_links_outside_of_code_are_looked_at():
    text = "[a](b.md#c) ![d](img/e.png) [f](https://g.org) [h](#i)\n```\n[j](k.md)\n```"
    assert linked_paths(text) == ["b.md", "img/e.png"]


def test_every_document_is_in_the_navigation_of_the_site(tmp_path: Path):
    site = tomllib.loads((ROOT / "docs" / "zensical.toml").read_text())
    named = set(pages_of(site["project"]["nav"]))
    decisions = ROOT / "docs" / "decisions"
    pages = [path for path in (ROOT / "docs").rglob("*.md") if path.parent != decisions]
    assert sorted({path.relative_to(ROOT).as_posix() for path in pages} - named) == []
    link_documents(tmp_path)
    written = {path.relative_to(tmp_path).as_posix() for path in tmp_path.rglob("*.md")}
    generated = {f"reference/{name}.md" for name in (*COMMANDS, "other-commands", "python")}
    assert sorted(named - written - generated) == []
    assert sorted(generated - named) == []


def test_the_site_has_every_decision_and_result_that_is_linked(tmp_path: Path):
    link_documents(tmp_path)
    for folder, index in (("docs/decisions", "README.md"), ("benchmarks/results", "index.md")):
        names = {path.name for path in (ROOT / folder).iterdir() if path.is_file()} - {index}
        assert {path.name for path in (tmp_path / folder).iterdir()} == {*names, index}
        listed = linked_paths((tmp_path / folder / index).read_text())
        assert sorted(listed) == sorted(names)


def test_every_command_and_public_name_has_a_place_in_the_reference():
    assert {*COMMANDS, *USAGES} == set(VERBS)
    named = re.findall(r"heading: gmijax\.(\w+)", python_page())
    assert sorted(named) == sorted(name for name in gmijax.__all__ if name != "__version__")


def test_a_page_of_keys_shows_values_limits_default_and_meaning():
    rows = command_page("play").splitlines()
    seed = next(row for row in rows if row.startswith("| `seed`"))
    assert "| int, 0 to 2147483647 | `0` | seed of the episodes' starts" in seed
    assert any("| `auto`, `mp4`, `gif`, `both`, `none` | `auto` |" in row for row in rows)


def test_keys_stand_by_topic_with_the_usual_ones_first():
    headings = re.findall(r"^## (.*)$", command_page("train"), flags=re.MULTILINE)
    assert headings == [topic.title for topic in TOPICS.values() if topic.title in headings]
    assert headings[0] == TOPICS[""].title
    keys = re.findall(r"^\| `([\w.]+)`", command_page("train"), flags=re.MULTILINE)
    assert len(keys) == len(list(keys_of(COMMANDS["train"], partial(defaults, "train"))))


def test_a_page_of_a_command_like_train_shows_what_differs_alone():
    keys = re.findall(r"^\| `([\w.]+)`", command_page("search"), flags=re.MULTILINE)
    assert keys == ["num_envs", "plan.gmis_per_gpu"]


@pytest.mark.parametrize("document", documents(), ids=lambda path: path.stem)
def test_a_list_stands_below_an_empty_line(document: Path):
    prose = re.sub(r"```.*?```", "", document.read_text(), flags=re.DOTALL)
    # Below a paragraph the site would show it as part of that; GitHub shows a list.
    assert re.findall(r"(?:\A|\n\n)([^\n#| -].*)\n(?:- |1\. )", prose) == []


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
