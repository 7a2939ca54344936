"""Guesses of what the columns of an export are, for the table that a person corrects."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from pipeline.historian.cells import sentinels, unit_slips, usual
from pipeline.historian.character import quantum
from pipeline.historian.export import Export, Series
from pipeline.historian.reason import Reason
from pipeline.historian.tags import Guess, Tag

ENDINGS: tuple[tuple[str, str], ...] = (
    (r"(mode|md|auto)$", "mode"),
    (r"(^|[ ._:/-])(sp|spt|setpoint|set point|sollwert|w)([ ._:/-]|$)", "sp"),
    (r"(^|[ ._:/-])(op|out|mv|co|valve|stellwert|y)([ ._:/-]|$)", "mv"),
    (r"(^|[ ._:/-])(pv|cv|me|meas|istwert|x)([ ._:/-]|$)", "pv"),
)
HELD_SHARE = 0.9  # of the readings equal to the one before: moved in steps
LOOP = re.compile(r"^(?P<loop>.*?)[ ._:/-]+[A-Za-z ]+$")


def guesses(export: Export, units: Mapping[str, str]) -> list[Guess]:
    """One guess for every column, in the order of the file."""
    found = [_guess(s, units.get(name, "")) for name, s in export.series.items()]
    if not any(g.tag.role == "mv" for g in found):  # names say nothing: what moves in steps may be one
        found = [
            replace(g, tag=replace(g.tag, role="mv"), remark=f"{g.remark}; guessed: moves in steps".strip("; "))
            if not g.tag.role and g.remark.startswith("moves in steps")
            else g
            for g in found
        ]
    if not any(g.tag.role == "pv" for g in found):
        loops = {m["loop"] for g in found if g.tag.role in {"mv", "sp"} and (m := LOOP.match(g.tag.tag))}
        free = [g for g in found if not g.tag.role and g.good > 0 and g.step >= 0 and g.tag.low is not None]
        own = [g for g in free if g.tag.tag in loops] or free[:1]
        found = [replace(g, tag=replace(g.tag, role="pv")) if g in own else g for g in found]
    return found


def _guess(series: Series, unit: str) -> Guess:
    tag, good = series.tag, float(series.good.mean()) if len(series) else 0.0
    role = next((r for pattern, r in ENDINGS if re.search(pattern, tag, re.IGNORECASE)), "")
    texts = sum(series.texts.values())
    if texts > 0.5 * len(series):
        words = ", ".join(t for t, _ in series.texts.most_common(4))
        return Guess(Tag(tag, role if role == "mode" else "", unit), 0.0, good, f"texts: {words}")
    values = series.value[series.good]
    if not values.size:
        return Guess(Tag(tag, "", unit), 0.0, good, "no good reading")
    codes, found = sentinels(np.where(series.code == Reason.GOOD, series.value, np.nan))
    plain = series.value[series.good & ~codes]
    plain = plain[~unit_slips(plain)[0]]
    remarks = []
    still = np.abs(np.diff(plain)) <= 0
    if np.ptp(plain) == 0:
        remarks.append("constant")
    elif still.mean() >= HELD_SHARE:
        remarks.append("moves in steps")
    if found:
        remarks.append("codes: " + ", ".join(found))
    if texts:
        remarks.append("texts: " + ", ".join(repr(t) for t, _ in series.texts.most_common(3)))
    low, high = _range(plain, unit, role)
    kept = good - float(codes.mean())
    return Guess(Tag(tag, role, unit, low, high), quantum(plain), kept, "; ".join(remarks))


def _range(values: Sequence[float] | np.ndarray, unit: str, role: str) -> tuple[float | None, float | None]:
    low, high = usual(np.asarray(values, dtype=np.float64))
    if not low < high:
        low, high = float(np.min(values)), float(np.max(values))
    if not low < high:
        return None, None
    if unit == "%" and low >= 0 and high <= 100:
        return 0.0, 100.0
    if role == "mv":
        return float(np.min(values)), float(np.max(values))
    pad = 0.25 * (high - low)
    return float(f"{low - pad:.3g}"), float(f"{high + pad:.3g}")
