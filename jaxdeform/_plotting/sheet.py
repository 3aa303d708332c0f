"""Put panels on a sheet, with their titles, labels, a colour bar and a legend."""

from collections.abc import Sequence
from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import UInt8

from jaxdeform._plotting.color import Scale, written
from jaxdeform._plotting.scene import FIXED, MOVED

_INK, _FAINT, _WARN = "#1f2733", "#5a6675", "#b3123f"
_MOST_LINES = 3


class Legend(NamedTuple):
    """What the colours mean."""

    scale: Scale | None
    label: str
    handles: tuple[str, ...]
    """``fixed``, ``moved`` or both, if handles are shown."""


class Text(NamedTuple):
    """A line of a title."""

    words: str
    warns: bool = False


class Sheet:
    """Panels of one size in rows, with one size of type for all that is written.

    The type follows the width of a panel: 1/24 of it, at least 12 pixels.
    """

    def __init__(self, width: int, height: int, legend: Legend) -> None:
        """Take the size of a panel."""
        self.width, self.height, self.legend = width, height, legend
        self.type = max(12, round(width / 24))
        self.font = _font(self.type)
        self.line = round(1.35 * self.type)

    # ------------------------------------------------------------ sheets

    def arrange(
        self,
        panels: Sequence[UInt8[np.ndarray, "_ _ 3"]],
        titles: Sequence[Sequence[Text]],
        columns: int,
        row_labels: Sequence[str] = (),
        column_labels: Sequence[str] = (),
        title_lines: int = 0,
    ) -> UInt8[np.ndarray, "_ _ 3"]:
        """Return the picture. Labels of rows stand on the left, those of columns on top.

        Above each panel is room for ``title_lines`` lines, or more if a title has more.
        """
        from PIL import Image, ImageDraw

        lines = [self.wrapped(title) for title in titles]
        heads = [self.wrapped([Text(label)]) for label in column_labels]
        strip = self.line * max([title_lines, *map(len, lines)])
        strip += self.type // 2 if strip else 0
        top = max(map(len, heads), default=0) * self.line + (self.type if heads else 0)
        sides = [self.wrapped([Text(label)], self.width // 2) for label in row_labels]
        wide = [self.font.getlength(text.words) for side in sides for text in side]
        left = int(max(wide, default=0)) + (2 * self.type if sides else 0)
        rows = -(-len(panels) // columns)
        across = left + columns * self.width
        foot = self._foot(across)
        down = top + rows * (strip + self.height) + foot.shape[0]
        sheet = Image.new("RGB", (across, down), "white")
        pen = ImageDraw.Draw(sheet)
        for c, head in enumerate(heads):
            self._write(pen, head, left + c * self.width, self.type // 2)
        for r, side in enumerate(sides):
            middle = top + r * (strip + self.height) + strip + self.height // 2
            self._write(pen, side, self.type, middle - len(side) * self.line // 2, centred=False)
        for k, (panel, title) in enumerate(zip(panels, lines, strict=True)):
            x = left + k % columns * self.width
            y = top + k // columns * (strip + self.height)
            self._write(pen, title, x, y + self.type // 2)
            sheet.paste(Image.fromarray(panel), (x, y + strip))
        sheet.paste(Image.fromarray(foot), (0, down - foot.shape[0]))
        return np.asarray(sheet)

    # ------------------------------------------------------------ words

    def _write(
        self, pen: Any, lines: Sequence[Text], x: int, y: int, *, centred: bool = True
    ) -> None:
        """Write lines below each other, in the middle of a panel that begins at x."""
        for k, (words, warns) in enumerate(lines):
            shift = (self.width - self.font.getlength(words)) / 2 if centred else 0
            place = (x + max(0, round(shift)), y + k * self.line)
            pen.text(place, words, fill=_WARN if warns else _INK, font=self.font)

    def wrapped(self, title: Sequence[Text], room: int | None = None) -> list[Text]:
        """Break lines that are wider than a panel; after the third line three dots."""
        room = (room or self.width) - self.type
        out = []
        for words, warns in title:
            lines, rest = [], words.split()
            while rest:
                count = len(rest)
                while count > 1 and self.font.getlength(" ".join(rest[:count])) > room:
                    count -= 1
                lines.append(" ".join(rest[:count]))
                rest = rest[count:]
            if len(lines) > _MOST_LINES:
                lines = [*lines[: _MOST_LINES - 1], f"{lines[_MOST_LINES - 1]} ..."]
            out += [Text(self._shortened(line, room), warns) for line in lines]
        return out

    def _shortened(self, line: str, room: int) -> str:
        if self.font.getlength(line) <= room:
            return line
        while line and self.font.getlength(f"{line}...") > room:
            line = line[:-1]
        return f"{line}..."

    # ------------------------------------------------------------ colour bar and legend

    def _foot(self, across: int) -> UInt8[np.ndarray, "_ _ 3"]:
        """Return the strip below the panels: the bar and the handles, in as many rows as needed."""
        parts = [] if self.legend.scale is None else [self._bar(self.legend.scale, across)]
        parts += [self._dot(name) for name in self.legend.handles]
        rows: list[list[np.ndarray]] = []
        for part in parts:
            if rows and sum(one.shape[1] for one in (*rows[-1], part)) <= across:
                rows[-1].append(part)
            else:
                rows.append([part])
        strips = [np.full((0, across, 3), 255, np.uint8)]
        for row in rows:
            tall = max(part.shape[0] for part in row)
            level = [_centred(part, part.shape[1], tall) for part in row]
            strips.append(_centred(np.concatenate(level, axis=1), across, tall))
        return np.concatenate(strips)

    def _bar(self, scale: Scale, across: int) -> UInt8[np.ndarray, "_ _ 3"]:
        """Return the colour bar: its title on the left, the numbers below it."""
        from PIL import Image, ImageDraw

        em, font = self.type, self.font
        title = self._shortened(self.legend.label, max(across // 2, 1))
        words = round(font.getlength(title))
        widest = max(font.getlength(written(mark)) for mark in scale.marks(closest=0.0))
        apart = round(widest) + em // 2  # from number to number, so that they do not touch
        length = max(apart, min(15 * em, across - words - 6 * em))
        left = words + 3 * em
        wide, tall = left + length + 3 * em, 4 * em
        image = Image.new("RGB", (wide, tall), "white")
        pen = ImageDraw.Draw(image)
        top, thick = em, em
        pen.text((em, top + thick / 2), title, fill=_INK, font=font, anchor="lm")
        ramp = np.rint(255 * scale.bar(length)).astype(np.uint8)
        image.paste(Image.fromarray(np.repeat(ramp[None], thick, axis=0)), (left, top))
        for mark in scale.marks(closest=min(1.0, max(3.2 * em, apart) / length)):
            x = left + float(scale.place(np.array(mark))) * (length - 1)
            pen.line([(x, top + thick), (x, top + thick + em // 4)], fill=_FAINT)
            place = (x, top + thick + em // 3)
            pen.text(place, written(mark), fill=_INK, font=font, anchor="ma")
        return np.asarray(image)

    def _dot(self, name: str) -> UInt8[np.ndarray, "_ _ 3"]:
        """Return the legend of one kind of handles."""
        from PIL import Image, ImageDraw

        em, text = self.type, f"{name} handles"
        wide = round(self.font.getlength(text)) + 3 * em
        image = Image.new("RGB", (wide, 2 * em), "white")
        # Drawn four times as large: Pillow's circles have steps.
        large = Image.new("RGB", (4 * em, 4 * em), "white")
        color = FIXED if name == "fixed" else MOVED
        ImageDraw.Draw(large).ellipse([0.6 * em, 0.6 * em, 3.4 * em, 3.4 * em], fill=color)
        image.paste(large.resize((em, em)), (em // 2, em // 2))
        pen = ImageDraw.Draw(image)
        pen.text((2 * em, em), text, fill=_INK, font=self.font, anchor="lm")
        return np.asarray(image)


def _centred(part: np.ndarray, wide: int, tall: int) -> np.ndarray:
    """Return a picture in the middle of a white one, cut off where it is larger."""
    part = part[:tall, :wide]
    out = np.full((tall, wide, 3), 255, np.uint8)
    y, x = (tall - part.shape[0]) // 2, (wide - part.shape[1]) // 2
    out[y : y + part.shape[0], x : x + part.shape[1]] = part
    return out


@lru_cache
def _font(size: int) -> Any:
    import matplotlib  # comes with pyvista, and with it a font that has Greek letters
    from PIL import ImageFont

    path = Path(matplotlib.get_data_path()) / "fonts" / "ttf" / "DejaVuSans.ttf"
    return ImageFont.truetype(str(path), size)
