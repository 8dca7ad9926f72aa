"""The README as the package index shows it: every link is whole, and all follow from one URL."""

from __future__ import annotations

import importlib.util
import re
import tomllib
from pathlib import Path

ROOT = Path(__file__).parents[2]
HOOK = ROOT / ".ci" / "package_page.py"
REPOSITORY = "https://example.org/somebody/gmijax"


def page(text: str) -> str:
    spec = importlib.util.spec_from_file_location("package_page", HOOK)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module.with_whole_links(text, REPOSITORY, "v1.2.3")


def test_links_and_pictures_are_whole():
    text = "![a](docs/img/a.gif) [b](docs/b.md#c) [d](#e) [f](https://g.org) [![h](i.png)](j.md)"
    at = f"{REPOSITORY}/{{}}/v1.2.3/{{}}".format
    assert page(text) == (
        f"![a]({at('raw', 'docs/img/a.gif')}) [b]({at('blob', 'docs/b.md#c')}) [d](#e) "
        f"[f](https://g.org) [![h]({at('raw', 'i.png')})]({at('blob', 'j.md')})"
    )


def test_no_link_of_the_readme_stays_relative():
    targets = re.findall(r"\]\(([^)\s]+)\)", page((ROOT / "README.md").read_text()))
    assert len(targets) > 20
    assert [target for target in targets if not re.match(r"https?://|#", target)] == []


def test_the_repository_is_named_in_one_place():
    hooks = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["hatch"]["metadata"]
    repository = hooks["hooks"]["custom"]["repository"]
    names = [*ROOT.glob("*.*"), *(ROOT / "docs").rglob("*.*"), *(ROOT / ".github").rglob("*.*")]
    texts = {path: path.read_text(errors="ignore") for path in names if path.is_file()}
    assert [path.name for path, text in texts.items() if repository in text] == ["pyproject.toml"]
