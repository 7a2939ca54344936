"""Whether a program printed what a page states: words as they are, numbers to the digits shown. Not a test itself."""

from __future__ import annotations

import math
import re

NUMBER = re.compile(r"(-?\d+(?:\.\d+)?(?:e[-+]\d+)?)(\.\.\.)?")


def says(stated: str, printed: str) -> bool:
    """Whether a printed line is the stated one; ``433.6...`` stands for any number that begins so."""
    if NUMBER.sub("#", stated).split() != NUMBER.sub("#", printed).split():
        return False
    pairs = zip(NUMBER.finditer(stated), NUMBER.finditer(printed), strict=True)
    return all(_same(shown[1], found[1], cut=bool(shown[2])) for shown, found in pairs)


def _same(shown: str, found: str, *, cut: bool) -> bool:
    digits, _, power = shown.partition("e")
    step = 10.0 ** (int(power or 0) - len(digits.partition(".")[2]))
    value = float(found)
    return found.startswith(shown) if cut else math.isclose(value, float(shown), rel_tol=0, abs_tol=0.5001 * step)


def assert_stated(stated: str, printed: str, where: str) -> None:
    """Each stated line was printed, in this order; a page may leave lines out."""
    lines = iter(printed.splitlines())
    for line in filter(str.strip, stated.splitlines()):
        assert any(says(line, found) for found in lines), f"{where} states {line!r}; printed:\n{printed[-2000:]}"
