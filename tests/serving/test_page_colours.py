"""The colours of the operator's page, from its style sheet: words and lines are told from what lies behind them."""

from __future__ import annotations

import re
from collections.abc import Mapping
from itertools import chain
from pathlib import Path
from typing import TypeAlias

import pytest

import loopwright.serving.page

CSS = (Path(loopwright.serving.page.__file__).parent / "static" / "page.css").read_text()
WORDS, SHAPES = 4.5, 3.0  # WCAG AA

Colour: TypeAlias = tuple[float, float, float]


def variables(selector: str) -> dict[str, str]:
    (block,) = re.findall(rf"^{re.escape(selector)} \{{(.*?)\}}", CSS, re.DOTALL | re.MULTILINE)
    return dict(re.findall(r"--([\w-]+): (#[0-9a-f]+);", block))


LIGHT = variables(":root")
THEMES = {"light": LIGHT, "dark": LIGHT | variables(':root[data-theme="dark"]')}


def over(colour: str, ground: Colour, opacity: float = 1.0) -> Colour:
    """A colour, perhaps half transparent, on a ground."""
    parts = [int(colour[i : i + 2], 16) / 255 for i in range(1, len(colour), 2)]
    share = opacity * (parts[3] if len(parts) == 4 else 1.0)
    red, green, blue = (share * c + (1 - share) * g for c, g in zip(parts[:3], ground, strict=True))
    return red, green, blue


def light(colour: Colour) -> float:
    """Relative luminance, WCAG 2.2."""
    red, green, blue = (v / 12.92 if v <= 0.04045 else ((v + 0.055) / 1.055) ** 2.4 for v in colour)
    return 0.2126 * red + 0.7152 * green + 0.0722 * blue


def contrast(a: Colour, b: Colour) -> float:
    low, high = sorted((light(a), light(b)))
    return (high + 0.05) / (low + 0.05)


def ground(theme: Mapping[str, str], name: str) -> Colour:
    """What lies behind; a band lies on the panel."""
    panel = over(theme["panel"], (1.0, 1.0, 1.0))
    return panel if name == "panel" else over(theme[name], panel)


WRITTEN = {
    "ink": ("ground", "panel", "button", "alarm-ground"),
    "ink-2": ("ground", "panel", "button", "alarm-ground"),
    "alarm": ("panel", "alarm-ground"),
    "watch": ("panel", "watch-ground"),
}
DRAWN = {
    **dict.fromkeys(("pv", "sp", "mv", "law", "beside"), ("panel",)),
    "focus": ("ground", "panel", "button"),
    "edge": ("panel",),
}


@pytest.mark.parametrize("name", THEMES)
def test_words_and_lines_are_told_from_their_ground(name: str) -> None:
    theme = THEMES[name]
    assert len(set(theme) & set(chain(WRITTEN, DRAWN))) == len(WRITTEN) + len(DRAWN)
    for needed, pairs in ((WORDS, WRITTEN), (SHAPES, DRAWN)):
        for colour, grounds in pairs.items():
            for behind in grounds:
                base = ground(theme, behind)
                assert contrast(over(theme[colour], base), base) >= needed, (colour, behind)


@pytest.mark.parametrize("name", THEMES)
def test_old_values_are_paler_and_can_be_read(name: str) -> None:
    (rule,) = re.findall(r"^body\.old [^{]*\{([^}]*)\}", CSS, re.MULTILINE)
    assert set(re.findall(r"--([\w-]+): var\(--ink\);", rule)) == {"ink-2", "alarm", "watch"}
    (said,) = re.findall(r"opacity: ([.\d]+);", rule)
    theme, panel = THEMES[name], ground(THEMES[name], "panel")
    for behind in ("panel", "watch-ground"):
        first = ground(theme, behind)
        mixed = [[float(said) * c + (1 - float(said)) * p for c, p in zip(of, panel, strict=True)]
                 for of in (over(theme["ink"], first), first)]  # fmt: skip
        assert contrast(*((red, green, blue) for red, green, blue in mixed)) >= WORDS, behind
