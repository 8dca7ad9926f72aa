"""What is written into films: labels of the environments, and lines below them. No jax here."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property
from typing import Final

import numpy as np
from PIL import Image as Pillow
from PIL import ImageDraw, ImageFont

from gmijax.sim.stage import Image

_SIZE: Final = 13
_LINE: Final = 18
_MARGIN: Final = 6
_NARROWEST_TILE: Final = 120
_NARROWEST_STRIP: Final = 320
_INK, _GROUND = (240, 240, 240), (24, 26, 30)
_VEIL: Final = 0.4
"""Brightness of what is behind a label."""


class Captions:
    """The texts of one film; those that do not fit a small picture are left out.

    Args:
      labels: one for each environment.
      lines: below the picture; the last one gets the time of the film, on the right.
    """

    def __init__(self, labels: Sequence[str], lines: Sequence[str]) -> None:
        self._labels, self._lines = labels, lines

    def label(self, index: int, tile: Image) -> Image:
        """The tile [height, width, 3] with its environment's label in the upper left corner."""
        if index >= len(self._labels) or tile.shape[1] < _NARROWEST_TILE:
            return tile
        text = self._labels[index]
        width = min(tile.shape[1], int(self._font.getlength(text)) + 2 * _MARGIN)
        corner = tile[:_LINE, :width]
        ground = Pillow.fromarray((corner * _VEIL).astype(np.uint8))
        ImageDraw.Draw(ground).text((_MARGIN, 1), text, _INK, self._font)
        labelled = tile.copy()
        labelled[:_LINE, :width] = np.asarray(ground)
        return labelled

    def below(self, picture: Image, time_s: float) -> Image:
        """The picture with the lines below it."""
        width = picture.shape[1]
        if not self._lines or width < _NARROWEST_STRIP:
            return picture
        strip = Pillow.new("RGB", (width, len(self._lines) * _LINE + 4), _GROUND)
        draw = ImageDraw.Draw(strip)
        for number, line in enumerate(self._lines):
            draw.text((_MARGIN, 2 + number * _LINE), line, _INK, self._font)
        # Over what may be a long line.
        clock = f"{time_s:.1f} s"
        left = width - int(self._font.getlength(clock)) - _MARGIN
        top = 2 + (len(self._lines) - 1) * _LINE
        draw.rectangle((left - _MARGIN, top, width, top + _LINE), _GROUND)
        draw.text((left, top), clock, _INK, self._font)
        return np.concatenate([picture, np.asarray(strip)])

    @cached_property
    def _font(self) -> ImageFont.FreeTypeFont | ImageFont.ImageFont:
        return ImageFont.load_default(_SIZE)
