"""A display that is updated while a job or a sweep runs."""

from __future__ import annotations

import time
from collections.abc import Callable
from contextlib import suppress
from typing import Any, Self

from rich.console import Console, RenderableType
from rich.live import Live
from rich.text import Text

REFRESH_S = 0.25
"""Between two pictures of a panel."""

_BAR_WIDTH = 30


class LiveDisplay:
    """A panel on a terminal while it is entered, plain lines elsewhere.

    Whatever goes wrong with it, such as a terminal that is closed, ends the display and nothing
    else. So it is drawn by the caller's thread, where errors can be caught.

    Args:
      console: nothing is shown on a quiet one.

    Attributes:
      has_panel: whether there is a panel; it may be drawn four times a second.
    """

    def __init__(self, console: Console) -> None:
        self._console = console
        self.has_panel = console.is_interactive and not console.quiet
        self._is_off = console.quiet
        self._drawn_s = 0.0
        self._live = Live(console=console, auto_refresh=False, transient=True)

    def __enter__(self) -> Self:
        if self.has_panel:
            self._try(self._live.start)
        return self

    def __exit__(self, *exc: Any) -> None:
        self._drawn_s = 0.0  # What is shown after it, is shown at once.
        if self._live.is_started:
            self._try(self._live.stop)

    def show(self, make: Callable[[], RenderableType | None]) -> None:
        """Shows the panel that `make` returns, if any; may be called often.

        `make` prints by itself what is to stay. It is called when it is time to draw.
        """
        now_s = time.monotonic()
        if self._is_off or (self.has_panel and now_s - self._drawn_s < REFRESH_S):
            return
        self._drawn_s = now_s
        self._try(lambda: self._draw(make()))

    def _draw(self, panel: RenderableType | None) -> None:
        if panel is not None and self._live.is_started:
            self._live.update(panel, refresh=True)

    def _try(self, act: Callable[[], object]) -> None:
        try:
            act()
        except Exception as error:
            was_off, self._is_off = self._is_off, True
            if not was_off:
                self.__exit__()
                with suppress(Exception):
                    self._console.print(f"progress is no longer shown: {error!r}")


def bar(part: float, width: int = _BAR_WIDTH) -> Text:
    """A bar of which a part, 0 to 1, is filled."""
    filled = round(part * width)
    return Text.assemble(("━" * filled, "green"), ("━" * (width - filled), "dim"))


def clock(seconds: float) -> str:
    """Seconds as `m:ss`, or `h:mm:ss`."""
    minutes, rest = divmod(round(seconds), 60)
    hours = f"{minutes // 60}:{minutes % 60:02d}" if minutes >= 60 else str(minutes)
    return f"{hours}:{rest:02d}"
