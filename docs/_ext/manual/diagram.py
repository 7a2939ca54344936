"""Block diagrams as SVG, drawn from text.

The first lines are the grid: a row of the picture a line, cells apart by ``|``, ``.`` for none. A cell is ``[box]``,
``((plant))``, ``(+)`` for a sum, or the name of a signal; ``name = words`` after a colon gives a cell another text.
The lines after ``--`` are the arrows: ``a > b``, ``a > b : words``, ``a > b below``, ``a > b above``.
``floors`` as the first line draws one box a name instead, the upper ones on the lower ones.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass, replace
from html import escape

WIDE, HIGH, GAP_Y, MARGIN = 128, 44, 44, 22
LETTER = 6.3  # width of a label's letter [px]
ARROW = re.compile(r"^(\S+) > (\S+)( below| above)?(?: : (.+))?$")
Point = tuple[float, float]


@dataclass(frozen=True, slots=True)
class Cell:
    """One element: its key, its shape (box, plant, sum, signal), its words, its place in the grid."""

    key: str
    shape: str
    words: str
    row: int
    column: int
    gap: float = 46  # between columns [px]

    @property
    def centre(self) -> Point:
        """Centre [px]."""
        return (
            MARGIN + WIDE / 2 + self.column * (WIDE + self.gap),
            MARGIN + GAP_Y / 2 + HIGH / 2 + self.row * (HIGH + GAP_Y),
        )

    @property
    def half(self) -> Point:
        """Half of width and height [px]."""
        if self.shape == "sum":
            return 13, 13
        if self.shape == "signal":
            return max(16, 3.6 * len(self.words) + 5), 12
        return WIDE / 2, HIGH / 2

    def side(self, towards: str) -> Point:
        """Middle of a side: left, right, top, bottom."""
        (x, y), (w, h) = self.centre, self.half
        return {"left": (x - w, y), "right": (x + w, y), "top": (x, y - h), "bottom": (x, y + h)}[towards]


def drawn(text: str, words: str) -> str:
    """The picture as SVG; ValueError names the line that cannot be read."""
    lines = [line.strip() for line in text.splitlines() if line.strip()]
    if lines and lines[0] == "floors":
        return _floors(lines[1:], words)
    at = lines.index("--") if "--" in lines else len(lines)
    gap = max([46.0, *(LETTER * len(line.split(" : ")[1]) + 22 for line in lines[at:] if " : " in line)])
    cells = {cell.key: replace(cell, gap=gap) for row, line in enumerate(lines[:at]) for cell in _cells(row, line)}
    arrows = [_arrow(line, cells) for line in lines[at + 1 :]]
    columns, rows = max(c.column for c in cells.values()) + 1, max(c.row for c in cells.values()) + 1
    width, height = 2 * MARGIN + columns * (WIDE + gap) - gap, 2 * MARGIN + rows * (HIGH + GAP_Y)
    lanes = {"below": 0, "above": 0}
    body = [path for arrow in arrows for path in _path(*arrow, lanes)] + [_shape(c) for c in cells.values()]
    return _svg(body, width, height, words)


def _cells(row: int, line: str) -> Iterator[Cell]:
    for column, text in enumerate(part.strip() for part in line.split("|")):
        if text in {".", ""}:
            continue
        key, _, words = text.partition("=")
        key, words = key.strip(), words.strip() or key.strip()
        for shape, form in (("plant", r"\(\((.+)\)\)"), ("sum", r"\((.)\)"), ("box", r"\[(.+)\]")):
            if match := re.fullmatch(form, words):
                own = match[1] if key == words else key
                yield Cell(own, shape, match[1], row, column)
                break
        else:
            yield Cell(key, "signal", words, row, column)


def _arrow(line: str, cells: dict[str, Cell]) -> tuple[Cell, Cell, str, str]:
    match = ARROW.match(line)
    if match is None or match[1] not in cells or match[2] not in cells:
        raise ValueError(f"the arrow {line!r} cannot be read; write `a > b [below|above] [: words]` of {list(cells)}")
    return cells[match[1]], cells[match[2]], (match[3] or "").strip(), match[4] or ""


def _path(a: Cell, b: Cell, lane: str, words: str, lanes: dict[str, int]) -> Iterator[str]:
    if lane:
        yield from _round(a, b, lane, words, lanes)
        return
    if a.row == b.row:
        start, end = (a.side("right"), b.side("left")) if a.column < b.column else (a.side("left"), b.side("right"))
        points = [start, end]
    elif a.column == b.column:
        start, end = (a.side("bottom"), b.side("top")) if a.row < b.row else (a.side("top"), b.side("bottom"))
        points = [start, end]
    elif a.row < b.row:
        start, end = a.side("bottom"), b.side("left" if a.column < b.column else "right")
        points = [start, (start[0], end[1]), end]
    else:
        start, end = a.side("right" if a.column < b.column else "left"), b.side("bottom")
        points = [start, (end[0], start[1]), end]
    yield _line(points)
    (x0, y0), (x1, y1) = (
        points[-2] if a.row < b.row and a.column != b.column else points[0],
        points[-1 if a.row < b.row else 1],
    )
    if words and y0 == y1:
        yield _text((x0 + x1) / 2, y0 - 6, words, "label")
    elif words:
        yield _text(x0 + 6, (y0 + y1) / 2 + 4, words, "label start")


def _round(a: Cell, b: Cell, lane: str, words: str, lanes: dict[str, int]) -> Iterator[str]:
    """An arrow that goes round the others: down (up) from a, along, and up (down) into b."""
    side, sign = ("bottom", 1) if lane == "below" else ("top", -1)
    (x0, y0), (x1, y1) = a.side(side), b.side(side)
    edge = max(y0, y1) if sign > 0 else min(y0, y1)
    y = edge + sign * (14 + 9 * (lanes[lane] % 3))
    shift = 7 * (lanes[lane] % 3)
    lanes[lane] += 1
    x0 += shift if b.column < a.column else -shift
    x1 += shift if b.column < a.column and b.shape == "box" else 0
    yield _line([(x0, y0), (x0, y), (x1, y), (x1, y1)])
    if words:
        yield _text((x0 + x1) / 2, y - 4, words, "label")


def _line(points: list[Point]) -> str:
    return f'<polyline points="{" ".join(f"{x:g},{y:g}" for x, y in points)}" marker-end="url(#tip)"/>'


def _text(x: float, y: float, words: str, kind: str) -> str:
    return f'<text x="{x:g}" y="{y:g}" class="{kind}">{escape(words)}</text>'


def _shape(c: Cell) -> str:
    (x, y), (w, h) = c.centre, c.half
    if c.shape == "signal":
        return _text(x, y + 4, c.words, "signal")
    if c.shape == "sum":
        return f'<circle cx="{x:g}" cy="{y:g}" r="{w:g}"/>' + _text(x, y + 5, c.words, "sum")
    rows = [line.strip() for line in c.words.split("/")]
    round_by = 22 if c.shape == "plant" else 4
    box = f'<rect x="{x - w:g}" y="{y - h:g}" width="{2 * w:g}" height="{2 * h:g}" rx="{round_by}"/>'
    return box + "".join(_text(x, y + 4 + 15 * (i - (len(rows) - 1) / 2), r, "box") for i, r in enumerate(rows))


def _floors(lines: list[str], words: str) -> str:
    high, body = 30, []
    for row, line in enumerate(lines):
        names = [name.strip() for name in line.split("|")]
        wide = (420 - 8 * (len(names) - 1)) / len(names)
        for i, name in enumerate(names):
            x, y = MARGIN + i * (wide + 8), MARGIN + row * high
            body.append(f'<rect x="{x:g}" y="{y:g}" width="{wide:g}" height="{high - 6}" rx="3"/>')
            body.append(_text(x + wide / 2, y + 16, name, "box"))
    x, bottom = MARGIN + 420 + 24, MARGIN + len(lines) * high
    body.append(_line([(x, MARGIN), (x, bottom - 6)]))
    body.append(_text(x + 8, (MARGIN + bottom) / 2, "imports", "label start"))
    return _svg(body, x + 90, bottom + MARGIN, words)


def _svg(body: list[str], width: float, height: float, words: str) -> str:
    tip = '<marker id="tip" viewBox="0 0 8 8" refX="8" refY="4" markerWidth="8" markerHeight="8" orient="auto">'
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" role="img" viewBox="0 0 {width:g} {height:g}" '
        f'style="max-width:{width:g}px"><title>{escape(words)}</title>'
        f'<defs>{tip}<path d="M0,0 L8,4 L0,8 z"/></marker></defs>{"".join(body)}</svg>'
    )
