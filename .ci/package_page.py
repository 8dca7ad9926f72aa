"""What the package index shows: the URLs of the project, and README.md with whole links.

A hook of hatchling, which runs when a wheel or an sdist is built. All URLs follow from
`tool.hatch.metadata.hooks.custom.repository` in pyproject.toml.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

from hatchling.metadata.plugin.interface import MetadataHookInterface

LINK = re.compile(r"(!\[[^\[\]]*\]|\])\((?![a-z]+:|#)([^)\s]+)\)")


class PackagePage(MetadataHookInterface):
    """Adds `urls` and `readme` to the metadata."""

    def update(self, metadata: dict[str, Any]) -> None:
        """Called with what pyproject.toml says, and the version."""
        repository, version = self.config["repository"], metadata["version"]
        owner, name = repository.split("/")[-2:]
        metadata["urls"] = {
            "Documentation": f"https://{owner}.github.io/{name}/",
            "Source": repository,
            "Issues": f"{repository}/issues",
            "Changelog": f"{repository}/blob/main/CHANGELOG.md",
        }
        text = (Path(self.root) / "README.md").read_text()
        metadata["readme"] = {
            "content-type": "text/markdown",
            "text": with_whole_links(text, repository, f"v{version}"),
        }


def with_whole_links(text: str, repository: str, tag: str) -> str:
    """README.md with links to the files as they are at a tag."""

    def whole(match: re.Match[str]) -> str:
        before, path = match.groups()
        kind = "raw" if before.startswith("!") else "blob"
        return f"{before}({repository}/{kind}/{tag}/{path})"

    return LINK.sub(whole, text)
