"""Kinds of dirt in an export, each as a clean one spoilt in one way."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from datetime import UTC, datetime

import numpy as np
from _exports import HEADER, NOISE, PERIOD_S, ROWS, TAGS, Array, Export, cells, experiment, export_of

from loopwright.pipeline.historian.cleaning.tags import Tag

CLEAN = experiment(0)
RANDOM = np.random.default_rng(11)
SPOT = np.sort(RANDOM.choice(np.arange(100, ROWS - 100), 40, replace=False))  # 1 % of the rows
LATE, MIDDLE = slice(2400, None), slice(1500, 1900)


@dataclass(frozen=True)
class Kind:
    """One kind of dirt: its name, and the export that has it."""

    name: str
    spoil: Callable[[], Export]


def at(values: Array, rows: object, new: object) -> Array:
    """A copy with some rows replaced."""
    out = values.copy()
    out[rows] = new  # type: ignore[index]
    return out


def pv(rows: object, new: object) -> Export:
    """The clean export with other PVs in some rows."""
    return export_of(CLEAN.with_(pv=at(CLEAN.pv, rows, new)))


def mv(rows: object, new: object) -> Export:
    """The clean export with other MVs in some rows."""
    return export_of(CLEAN.with_(mv=at(CLEAN.mv, rows, new)))


def moved(by: int) -> Export:
    """The MV stored ``by`` rows late (early where negative)."""
    u = CLEAN.mv
    late = np.r_[np.full(by, u[0]), u[:-by]] if by > 0 else np.r_[u[-by:], np.full(-by, u[-1])]
    return export_of(CLEAN.with_(mv=late))


def texts(word: str) -> Export:
    """A text in 1 % of the PV's cells."""
    rows = cells(CLEAN)
    for k in SPOT:
        rows[k][1] = word
    return export_of(rows)


def stamps(form: Callable[[float], str]) -> Export:
    """Times written by ``form``."""
    rows = [[form(float(r[0])), *r[1:]] for r in cells(CLEAN)]
    return export_of(rows)


def local(form: str, offset_s: Callable[[float], float] = lambda _: 0.0) -> Callable[[float], str]:
    """Time stamps in a form, with an offset of the local clock."""
    return lambda t: datetime.fromtimestamp(t + offset_s(t), UTC).strftime(form)


def by_exception(band: float) -> Export:
    """PV and DV stored beyond a dead band, the MV where it changes; one row a reading."""
    rows = []
    for name, values, own in zip(HEADER[1:], (CLEAN.pv, CLEAN.mv, CLEAN.dv), (band, 0.0, 4 * band), strict=True):
        last = np.inf
        for t, v in zip(CLEAN.time_s, values, strict=True):
            if abs(v - last) > own:
                rows.append([name, f"{t:.0f}", f"{v}"])
                last = v
    return Export({"export.csv": (("tag", "time", "value"), rows)}, options={"period_s": PERIOD_S, "hold_s": 3600.0})


def swinging_door(values: Array, band: float) -> Array:
    """Compressed with a corridor of ``band`` to each side, and drawn again on straight lines."""
    kept, k = [0], 0
    while k < len(values) - 1:
        high, low, j = np.inf, -np.inf, k + 1
        while j < len(values):
            high, low = (
                min(high, (values[j] + band - values[k]) / (j - k)),
                max(low, (values[j] - band - values[k]) / (j - k)),
            )
            if low > high:
                break
            j += 1
        k = max(j - 1, k + 1)
        kept.append(k)
    return np.interp(np.arange(len(values)), kept, values[kept])


def compressed(band: float) -> Export:
    """The PV through a swinging door."""
    return export_of(CLEAN.with_(pv=np.round(swinging_door(CLEAN.pv, band), 3)))


def ranged(unit: str, low: float, high: float) -> tuple[Tag, ...]:
    """The usual tags, with a range of the PV."""
    return (Tag("TIC-101.PV", "pv", unit, low, high), *TAGS[1:])


def sent_twice() -> Export:
    """1 % of the rows two times."""
    return export_of([row for k, row in enumerate(cells(CLEAN)) for _ in range(2 if k in SPOT else 1)])


def overlapping() -> Export:
    """Two files that share 800 rows."""
    rows = cells(CLEAN)
    return Export({"a.csv": (HEADER, rows[:2400]), "b.csv": (HEADER, rows[1600:])})


def the_same_twice() -> Export:
    """One export, given two times."""
    rows = cells(CLEAN)
    return Export({"a.csv": (HEADER, rows), "b.csv": (HEADER, rows)})


def regulation() -> Export:
    """A PI loop at one set point: the valve answers to noise and loads."""
    random = np.random.default_rng(3)
    n, y, inner, load = ROWS, 60.0, 60.0, 0.0
    p, u = np.empty(n), np.full(n, 50.0)
    for k in range(n):
        p[k] = y + random.normal(0, NOISE)
        if k:
            u[k] = np.clip(u[k - 1] - 0.8 * (p[k] - p[k - 1]) - 0.05 * (p[k] - 60), 0, 100)
        load = 0.98 * load + random.normal(0, 0.1)
        y += 0.25 * (inner - y)
        inner += 0.1 * (20 + 0.8 * u[max(k - 2, 0)] + load - inner)
    return export_of(CLEAN.with_(pv=np.round(p, 3), mv=np.round(u, 3), dv=CLEAN.dv))


def fifty_columns() -> Export:
    """47 more columns of other plants; the roles are named."""
    random = np.random.default_rng(4)
    more = [np.round(random.normal(100 * i, 3, ROWS), 2) for i in range(47)]
    header = (*HEADER, *(f"XI-{i}" for i in range(47)))
    return Export({"export.csv": (header, [[*row, *(f"{c[k]}" for c in more)] for k, row in enumerate(cells(CLEAN))])})


def two_files(shift_s: float) -> Export:
    """PV in one file, the others in a second one whose clock differs."""
    rows = cells(CLEAN)
    second = [[f"{float(r[0]) + shift_s:.3f}", *r[2:]] for r in rows]
    return Export({"a.csv": (HEADER[:2], [r[:2] for r in rows]), "b.csv": ((HEADER[0], *HEADER[2:]), second)})


def a_block_twice() -> Export:
    """Rows 1000 to 1400 stand again in place of rows 2000 to 2400, with the later times."""
    block = {c: at(getattr(CLEAN, c), slice(2000, 2400), getattr(CLEAN, c)[1000:1400]) for c in ("pv", "mv", "dv")}
    return export_of(CLEAN.with_(**block))


def commas_mixed(share: float) -> Export:
    """A decimal comma in some rows, quoted."""
    rows = cells(CLEAN)
    for k in np.flatnonzero(np.random.default_rng(6).random(ROWS) < share):
        rows[k][1] = rows[k][1].replace(".", ",")
    return export_of(rows, separator=";")


def drifting(course: Array) -> Export:
    """A wandering offset of the PV."""
    return export_of(CLEAN.with_(pv=np.round(CLEAN.pv + course, 3)))


def thinned() -> Export:
    """Every second row only in the second half."""
    return export_of([r for k, r in enumerate(cells(CLEAN)) if k < 2000 or k % 2 == 0])


def averaged() -> Export:
    """PV and flow as means over ten rows, repeated; the MV as it is."""

    def mean(v: Array) -> Array:
        return np.round(np.repeat(v.reshape(-1, 10).mean(axis=1), 10), 3)

    return export_of(CLEAN.with_(pv=mean(CLEAN.pv), dv=mean(CLEAN.dv)))


def shuffled() -> Export:
    """Rows in any order."""
    rows = cells(CLEAN)
    np.random.default_rng(7).shuffle(rows)
    return export_of(rows)


def lost(share: float) -> Export:
    """A share of the rows missing."""
    keep = np.random.default_rng(8).random(ROWS) >= share
    return export_of([r for r, kept in zip(cells(CLEAN), keep, strict=True) if kept])


def flow_around_zero(dead: bool) -> Export:
    """The PV around zero, so that 0 is a usual value, and a sensor that shows 0 for a while."""
    y = np.round(CLEAN.pv - 45.0, 3)
    return export_of(CLEAN.with_(pv=at(y, MIDDLE, 0.0) if dead else y), lower=45.0)


def jitter(share: float) -> Export:
    """Times that stray."""
    return export_of(
        CLEAN.with_(time_s=CLEAN.time_s + share * PERIOD_S * np.random.default_rng(9).uniform(-1, 1, ROWS))
    )


def dst_back(t: float) -> float:
    """Local time: an hour less from the middle on."""
    return 7200.0 if t < CLEAN.time_s[2000] else 3600.0


def dst_forward(t: float) -> float:
    """Local time: an hour more from the middle on."""
    return 3600.0 if t < CLEAN.time_s[2000] else 7200.0


def mixed_zones() -> Export:
    """Half of the file in local time, half in UTC, without a zone."""
    half = CLEAN.time_s[2000]
    return stamps(local("%Y-%m-%d %H:%M:%S", lambda t: 7200.0 if t < half else 0.0))


def ambiguous(t: float) -> str:
    """Day first, on the third of April."""
    return datetime.fromtimestamp(t + 86400 * 30, UTC).strftime("%d/%m/%Y %H:%M:%S")


def burst(values: Array) -> Array:
    """Thirty times the noise for 300 rows."""
    return at(values, slice(1500, 1800), values[1500:1800] + np.random.default_rng(10).normal(0, 30 * NOISE, 300))


def with_lines(*lines: tuple[int, list[str]]) -> Export:
    """Further lines within the file."""
    rows = cells(CLEAN)
    for place, row in lines:
        rows.insert(place, row)
    return export_of(rows)


def loop_with_modes() -> Export:
    """A controller in AUTO for a third of the time, its valve column frozen meanwhile: it shows the manual output."""
    mode = ["AUTO" if 1500 <= k < 2800 else "MAN" for k in range(ROWS)]
    u = at(CLEAN.mv, slice(1500, 2800), CLEAN.mv[1500])
    rows = [[*row, m] for row, m in zip(cells(CLEAN.with_(mv=u)), mode, strict=True)]
    tags = (*TAGS, Tag("TIC-101.MODE", "mode"))
    return Export({"export.csv": ((*HEADER, "TIC-101.MODE"), rows)}, tags=tags)


SWAPPED = (Tag("TIC-101.OP", "pv", "%"), Tag("TIC-101.PV", "mv", "degC"), TAGS[2])
t, c = np.arange(ROWS), CLEAN
QUIET = np.random.default_rng(1).normal(0, NOISE, 400).round(3)
HALVES = np.r_[500:1000, 2500:3000]
WALK = np.cumsum(np.random.default_rng(12).normal(0, 0.1, ROWS))

KINDS: tuple[Kind, ...] = (
    Kind("nothing", lambda: export_of(c)),
    Kind("empty cells, 1 %", lambda: texts("")),
    Kind("Bad Input, 1 %", lambda: texts("Bad Input")),
    Kind("inf, 1 %", lambda: texts("inf")),
    Kind("-9999 in 0.5 %", lambda: pv(SPOT[::2], -9999.0)),
    Kind("-9999 in the MV", lambda: mv(SPOT[::2], -9999.0)),
    Kind("0 of a dead sensor, 10 %", lambda: pv(MIDDLE, 0.0)),
    Kind("0 of a dead disturbance sensor, 10 %", lambda: export_of(c.with_(dv=at(c.dv, MIDDLE, 0.0)))),
    Kind("0 of a dead sensor, 0 is usual", lambda: flow_around_zero(True)),
    Kind("values around 0, no fault", lambda: flow_around_zero(False)),
    Kind("outliers of half the span, 1 %", lambda: pv(SPOT, c.pv[SPOT] + 25)),
    Kind("outliers of 5 % of the span, 1 %", lambda: pv(SPOT, c.pv[SPOT] + 2.5)),
    Kind("spikes in the MV, 1 %", lambda: mv(SPOT, np.where(c.mv[SPOT] > 50, 5.0, 95.0))),
    Kind("stuck for 200 rows", lambda: pv(slice(1500, 1700), c.pv[1500])),
    Kind("stuck at rest, the MV moves later", lambda: pv(slice(1500, 1530), c.pv[1500])),
    Kind("stuck with noise, 400 rows", lambda: pv(MIDDLE, c.pv[1500] + QUIET)),
    Kind("MV column frozen for 400 rows", lambda: mv(MIDDLE, c.mv[1500])),
    Kind("MV column frozen for 1,300 rows, mode says AUTO", loop_with_modes),
    Kind("disturbance stuck for 400 rows", lambda: export_of(c.with_(dv=at(c.dv, MIDDLE, c.dv[1500])))),
    Kind("saturated above 80 %", lambda: export_of(c.with_(pv=np.minimum(c.pv, np.quantile(c.pv, 0.8))))),
    Kind("a range that half of the PV leaves", lambda: export_of(c, tags=ranged("degC", 60, 90))),
    Kind("a range in another unit", lambda: export_of(c, tags=ranged("K", 300, 400))),
    Kind("quantized to 1 % of the span", lambda: export_of(c.with_(pv=np.round(c.pv / 0.5) * 0.5))),
    Kind("quantized to 10 % of the span", lambda: export_of(c.with_(pv=np.round(c.pv / 5) * 5))),
    Kind("MV one row late", lambda: moved(1)),
    Kind("MV three rows late", lambda: moved(3)),
    Kind("MV ten rows late", lambda: moved(10)),
    Kind("MV one row early", lambda: moved(-1)),
    Kind("MV three rows early", lambda: moved(-3)),
    Kind("MV sixty rows early", lambda: moved(-60)),
    Kind("two files, clocks 30 s apart", lambda: two_files(30.0)),
    Kind("two files, clocks 90 min apart", lambda: two_files(5400.0)),
    Kind("regulation at one set point", regulation),
    Kind("constant MV", lambda: mv(slice(None), 40.0)),
    Kind("drift of half the span", lambda: drifting(np.linspace(0, 25, ROWS))),
    Kind("drift of 10 % of the span", lambda: drifting(np.linspace(0, 5, ROWS))),
    Kind("random walk", lambda: drifting(WALK)),
    Kind("daily wave of 10 % of the span", lambda: drifting(2.5 * np.sin(2 * np.pi * t / 1500))),
    Kind("offset of 10 % after a calibration", lambda: drifting(np.where(t > 2000, 5.0, 0.0))),
    Kind("sensor's span changed by 20 % from the middle on", lambda: pv(LATE, 20 + 1.2 * (c.pv[LATE] - 20))),
    Kind("degF in 10 %", lambda: pv(MIDDLE, 1.8 * c.pv[MIDDLE] + 32)),
    Kind("degF in 40 %, to the end", lambda: pv(LATE, 1.8 * c.pv[LATE] + 32)),
    Kind("degF over a quarter, two times", lambda: pv(HALVES, 1.8 * c.pv[HALVES] + 32)),
    Kind("MV as a fraction in 40 %, to the end", lambda: mv(LATE, c.mv[LATE] / 100)),
    Kind("MV as a fraction in 10 %", lambda: mv(MIDDLE, c.mv[MIDDLE] / 100)),
    Kind("disturbance in t/h in 10 %", lambda: export_of(c.with_(dv=at(c.dv, MIDDLE, c.dv[MIDDLE] / 1000)))),
    Kind("sign turned in 10 %", lambda: pv(MIDDLE, -c.pv[MIDDLE])),
    Kind("PV and MV swapped", lambda: export_of(c, tags=SWAPPED)),
    Kind("a PV of another loop", lambda: export_of(c.with_(pv=experiment(5).pv))),
    Kind("jitter of 5 ms", lambda: jitter(0.0008)),
    Kind("jitter of 0.4 periods", lambda: jitter(0.4)),
    Kind("duplicated stamps", lambda: sent_twice()),
    Kind("shuffled rows", shuffled),
    Kind("a fifth of the rows lost", lambda: lost(0.2)),
    Kind("half of the rows lost", lambda: lost(0.5)),
    Kind("a block of 400 rows again, with later times", a_block_twice),
    Kind("two files that overlap", overlapping),
    Kind("the same file twice", the_same_twice),
    Kind("half the rate in the second half", thinned),
    Kind("stamps to the minute", lambda: stamps(local("%Y-%m-%d %H:%M"))),
    Kind("means over ten rows, repeated", averaged),
    Kind("stored beyond a dead band of 1 % of the span", lambda: by_exception(0.5)),
    Kind("swinging door, 1 % of the span, drawn again", lambda: compressed(0.5)),
    Kind("swinging door, 5 % of the span, drawn again", lambda: compressed(2.5)),
    Kind("ISO-8601 with a zone", lambda: stamps(local("%Y-%m-%dT%H:%M:%S+01:00", lambda _: 3600.0))),
    Kind("summer time ends (an hour twice)", lambda: stamps(local("%Y-%m-%d %H:%M:%S", dst_back))),
    Kind("summer time begins (an hour missing)", lambda: stamps(local("%Y-%m-%d %H:%M:%S", dst_forward))),
    Kind("local time in one half, UTC in the other", mixed_zones),
    Kind("day and month cannot be told", lambda: stamps(ambiguous)),
    Kind("decimal comma in 2 % of the rows", lambda: commas_mixed(0.02)),
    Kind("decimal comma in half of the rows", lambda: commas_mixed(0.5)),
    Kind("header again within the file", lambda: with_lines((1500, list(HEADER)), (3000, list(HEADER)))),
    Kind("a total in the last line", lambda: with_lines((ROWS, ["Total", "231,000", "", ""]))),
    Kind("50 columns", fifty_columns),
    Kind("noise thirty times as large for 300 rows", lambda: export_of(c.with_(pv=burst(c.pv)))),
)  # fmt: skip
