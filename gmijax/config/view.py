"""All keys of `gmijax view`."""

from __future__ import annotations

from dataclasses import dataclass
from urllib.parse import urlsplit

from gmijax.config.play import ViewRunConfig
from gmijax.config.schema import KeyGroup, doc
from gmijax.errors import ConfigError


@dataclass(frozen=True, kw_only=True)
class PageConfig(KeyGroup):
    """Where the page is served, and which clients may open it."""

    prefix = "view."

    host: str = doc(
        "address to listen at; 0.0.0.0: all addresses of this machine; the token in the URL is "
        "still needed"
    )
    port: int = doc(
        "port to listen at; the next free one if it is taken; 0: any", low=0, high=65535
    )
    allow_origin: tuple[str, ...] = doc(
        "origins of other pages through which the page may be opened, e.g. the proxy of a notebook"
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        for origin in self.allow_origin:
            if origin_of(origin) != origin:
                raise ConfigError(
                    f"view.allow_origin: {origin!r} is no origin; expected e.g. "
                    "https://hub.example.org"
                )


@dataclass(frozen=True, kw_only=True)
class ViewConfig(KeyGroup):
    """All keys of `gmijax view`."""

    run: ViewRunConfig
    view: PageConfig
    checkpoint: str | None = doc(
        "folder of a checkpoint, its env steps, or `best`; null: the latest, and every newer one "
        "while the run is trained. `shipped`, with env=TASK: the policy that comes with gmijax"
    )
    num_envs: int = doc("environments side by side", low=1, high=64)
    seed: int = doc("seed of the episodes' starts and of pushes", low=0, high=2**31 - 1)


def origin_of(url: str) -> str | None:
    """The origin of a URL as browsers write it; None where it has none."""
    try:
        parts = urlsplit(url)
        port = f":{parts.port}" if parts.port is not None else ""
    except ValueError:
        return None
    if parts.scheme not in ("http", "https") or not parts.hostname or "@" in parts.netloc:
        return None
    host = f"[{parts.hostname}]" if ":" in parts.hostname else parts.hostname
    return f"{parts.scheme}://{host}{port}"
