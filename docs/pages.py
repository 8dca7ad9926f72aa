"""Writes the pages of the documentation site: the documents, and the reference of the code.

`make docs` runs it and builds the site from what it wrote in `build/docs/pages/`. Documents are
linked there, with all that they link to, at the places that they have in the repository. So their
links hold in both, and `make docs-serve` shows what is changed in them.
"""

from __future__ import annotations

import re
import shutil
import sys
import tomllib
from pathlib import Path
from typing import Final

from docs.reference import COMMANDS, command_page, python_page, usages_page

ROOT: Final = Path(__file__).resolve().parents[1]
PAGES: Final = ROOT / "build" / "docs" / "pages"
STYLE: Final = ROOT / "docs" / "site.css"
SITE: Final = ROOT / "docs" / "zensical.toml"

LINK: Final = re.compile(r"!?\[[^\]]*\]\(([^)\s]+)\)")


def main() -> int:
    """Writes all pages anew; returns the exit code."""
    shutil.rmtree(PAGES, ignore_errors=True)
    link_documents(PAGES)
    (PAGES / "docs" / STYLE.name).symlink_to(STYLE)
    folder = PAGES / "reference"
    folder.mkdir()
    for name in COMMANDS:
        (folder / f"{name}.md").write_text(command_page(name))
    (folder / "other-commands.md").write_text(usages_page())
    (folder / "python.md").write_text(python_page())
    (PAGES.parent / SITE.name).write_text(SITE.read_text().replace("[project]\n", _project(), 1))
    return 0


def _project() -> str:
    """The head of the site's configuration, with the URLs that follow from the repository's."""
    hooks = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["hatch"]["metadata"]
    repository = hooks["hooks"]["custom"]["repository"]
    owner, name = repository.split("/")[-2:]
    if owner == "OWNER":  # There is no repository yet: no link to one.
        return "[project]\n"
    site = f"https://{owner}.github.io/{name}/"
    return f'[project]\nsite_url = "{site}"\nrepo_url = "{repository}"\n'


def documents() -> list[Path]:
    """The documents of the repository, apart from the changelog."""
    alone = [ROOT / name for name in ("README.md", "CONTRIBUTING.md", "CODE_OF_CONDUCT.md")]
    return [*alone, *sorted((ROOT / "docs").rglob("*.md"))]


def linked_paths(text: str) -> list[str]:
    """Targets of the links of a document that are paths, without the part behind `#`."""
    prose = re.sub(r"```.*?```", "", text, flags=re.DOTALL)
    targets = [target.partition("#")[0] for target in LINK.findall(prose)]
    return [target for target in targets if target and not re.match(r"[a-z]+:", target)]


def link_documents(pages: Path) -> None:
    """Links README.md (as the first page), docs/ and all that they link to into a folder.

    A folder that is linked to gets a page with a list of its files, unless it has a README.md.

    Raises:
      FileNotFoundError: a link to a file that does not exist.
    """
    readme = ROOT / "README.md"
    waiting = [readme, *(ROOT / "docs").rglob("*.md")]
    seen = set()
    while waiting:
        path = waiting.pop()
        if path in seen:
            continue
        seen.add(path)
        place = pages / ("index.md" if path == readme else path.relative_to(ROOT))
        (place if path.is_dir() else place.parent).mkdir(parents=True, exist_ok=True)
        if path.is_dir():
            files = sorted(file for file in path.iterdir() if file.is_file())
            if path / "README.md" not in files:
                lines = [f"- [{file.name}]({file.name})" for file in files]
                title = f"# Files in {path.relative_to(ROOT).as_posix()}"
                (place / "index.md").write_text("\n".join([title, "", *lines, ""]))
            waiting += files
            continue
        place.symlink_to(path.resolve(strict=True))
        if path.suffix == ".md":
            links = linked_paths(path.read_text())
            waiting += [(path.parent / link).resolve() for link in links]


if __name__ == "__main__":
    sys.exit(main())
