"""The loops of an export: which signals belong together, when each was at work, and the PI that ran it."""

from __future__ import annotations

from collections.abc import Callable, Container, Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from loopwright.pipeline.historian.cleaning.row_grid import Grid
from loopwright.pipeline.historian.cleaning.tags import Tag, automatic, by_hand
from loopwright.pipeline.historian.guessing import loop_in
from loopwright.pipeline.metrics import Array
from loopwright.pipeline.records.old_loops import OldController, Operated, operation
from loopwright.pipeline.records.record_file import RecordedSetPoints


# ------------------------------------------ set point, PV, mode and MV of a loop, and the rows in which it was at work
@dataclass(frozen=True, slots=True, eq=False)
class LoopRows:
    """One loop over the rows (n,) of the record in which it is automatic, or over all where no mode is known."""

    sp: Tag
    pv: Tag
    own_mvs: tuple[Tag, ...]  # the MV of the same name; where no name tells, all of them
    same_name: bool  # whether a name tells
    automatic: bool  # whether a mode says which rows these are
    manual: bool  # whether a mode says that it was in manual in each of them: no controller was at work
    rows: NDArray[np.bool_]  # of the grid
    piece: NDArray[np.int64]  # (n,) counts up where rows are left out: what the MV did meanwhile is not this loop's


def loops(
    grid: Grid, code: NDArray[np.uint8], tags: Sequence[Tag], modes: Mapping[str, Sequence[str]]
) -> Iterator[LoopRows]:
    """The loops whose set point is known. ``code`` (n,) is 0 in rows of the record, ``modes`` are names by tag."""
    sps, pvs, mvs = ([t for t in tags if t.role == role] for role in ("sp", "pv", "mv"))
    for place, sp in enumerate(sps):
        pv = _partner(sp, pvs, place)
        mode = _partner(sp, [t for t in tags if t.role == "mode"], 0 if len(sps) == 1 else -1)
        if pv is None:
            continue
        mv = _partner(sp, mvs, -1)
        rows = (code == 0) & ~np.isnan(grid.value[sp.tag])
        auto = _rows_of(automatic, grid.value[mode.tag], modes[mode.tag]) if mode is not None else None
        hand = _rows_of(by_hand, grid.value[mode.tag], modes[mode.tag]) if mode is not None else None
        known = auto is not None and bool(np.any(rows & auto))
        if auto is not None and known:
            rows = rows & auto
        if not rows.any():
            continue
        kept = np.flatnonzero(rows)
        piece = grid.piece[rows] + np.cumsum(np.diff(kept, prepend=kept[0] - 1) > 1)
        own, manual = tuple(mvs) if mv is None else (mv,), hand is not None and bool(hand[rows].all())
        yield LoopRows(sp, pv, own, mv is not None, known, manual, rows, piece)


def set_points(
    grid: Grid, code: NDArray[np.uint8], tags: Sequence[Tag], modes: Mapping[str, Sequence[str]], worked: Container[str]
) -> RecordedSetPoints:
    """The set points in the rows of the record, of loops whose mode is known or whose PV is among those ``worked`` on.

    Nobody knows of the others whether their set points were followed.
    """
    known = [loop for loop in loops(grid, code, tags, modes) if loop.automatic or loop.pv.name in worked]
    columns = [np.where(loop.rows, grid.value[loop.sp.tag], np.nan)[code == 0] for loop in known]
    values = np.column_stack(columns) if columns else np.empty((int(np.count_nonzero(code == 0)), 0))
    return RecordedSetPoints(tuple(loop.pv.name for loop in known), values.astype(np.float64))


def _partner(sp: Tag, tags: Sequence[Tag], place: int) -> Tag | None:
    """The tag of the same loop, as a person or its name says; else the one at a place, -1: none."""
    own = loop_in(sp)
    for tag in tags:
        if own and loop_in(tag) == own:
            return tag
    return tags[place] if 0 <= place < len(tags) else None


def _rows_of(kind: Callable[[str], bool], mode: Array, names: Sequence[str]) -> NDArray[np.bool_] | None:
    """Rows (n,) whose mode has a name of a kind; None where no mode of the tag has one."""
    known = [i for i, name in enumerate(names) if kind(name)]
    return np.isin(mode, known) if known else None


# ------------------------------------------------------------------------ how loops were run over the rows of a record
def operated(
    grid: Grid, code: NDArray[np.uint8], tags: Sequence[Tag], modes: Mapping[str, Sequence[str]]
) -> tuple[Operated, ...]:
    """The loops whose set point is known, without those that were in manual all the time: nothing followed it.

    ``code`` (n,) is 0 in rows of the record, ``modes`` are names by tag.
    """
    mvs, found = [t for t in tags if t.role == "mv"], []
    for loop in loops(grid, code, tags, modes):
        if loop.manual:
            continue
        rows, pv = loop.rows, loop.pv
        moves = np.column_stack([grid.value[t.tag][rows] for t in mvs]).astype(np.float64)
        error, travel = operation(
            grid.value[loop.sp.tag][rows], grid.value[pv.tag][rows], moves, loop.piece, grid.period_s
        )
        found.append(
            Operated(
                pv.name,
                pv.unit,
                int(np.count_nonzero(rows)),
                loop.automatic,
                error,
                {t.name: float(v) for t, v in zip(mvs, travel, strict=True)},
                {t.name: t.unit for t in mvs},
            )
        )
    return tuple(found)


# ----------------------------------------------------------- the PI, identified from set point, PV and MV in automatic
LOOP_WINDOWS = (600, 200, 60, 20)  # rows
LEAST_LOOP_WINDOWS = 12  # of a length, or too few are left to fit, to choose and to score
FEWEST_ASKED = 2  # windows with a moving set point that count by themselves
LATE_PV_ROWS = (0, 1)  # rows: in some exports the PV of a row is what the MV of that row made
FIT, CHOICE, SCORE = range(3)  # what every third window is for
LEAVING_OUT_ROUNDS = 8  # of leaving out windows in which something else moved the MV
FAR_WINDOW = 9.0  # times the median squared error, beyond which a window is left out of the fit
AT_MV_LIMIT = 1e-3  # of the MV's range: at a limit the law is another
MOST_AT_END = 0.1  # of a window's rows
# rows, and times the usual rest: one MV that rests longer is in manual, where no mode tells
MANUAL_REST, MANUAL_RESTS = 10, 10.0
BELIEVED = 0.8  # least share; hand operation and cascades stay below
# of the unexplained share: a further part or a shorter window must leave less, and no integral part more
BETTER_LOOP_FIT = 0.5

_P_ON_PV, _P_ON_SP, _I, _D = np.eye(4)
_P_ON_ERROR = _P_ON_PV + _P_ON_SP
FORMS: tuple[tuple[tuple[Array, ...], ...], ...] = (
    ((_P_ON_ERROR, _I), (_P_ON_PV, _I)),
    ((_P_ON_ERROR, _I, _D), (_P_ON_PV, _I, _D), (_P_ON_PV, _P_ON_SP, _I)),
    ((_P_ON_PV, _P_ON_SP, _I, _D),),
)
"""The forms that are tried, the plainest first, as bases of the numbers of the four parts: P on the error or on the
PV; with a derivative, or P on a share of the set point; with both."""


@dataclass(frozen=True, slots=True, eq=False)
class LoopWindows:
    """Windows of equal length, in which a loop was at work and its MV moved away from its limits.

    Summed over a window the velocity form says: the MV is the law's parts and a level that nobody knows, so that the
    digits of the export count once and not at every row. All arrays are without their mean over the window.
    """

    moved: Array  # (W, M) of the MV
    parts: Array  # (W, M, 4) proportional of the PV and of the set point [pv], integral [pv s], derivative [pv/s]

    @property
    def enough(self) -> bool:
        """Whether each third of them can tell."""
        return len(self.moved) >= LEAST_LOOP_WINDOWS

    def taken(self, use: int) -> LoopWindows:
        """Every third window."""
        return LoopWindows(self.moved[use::3], self.parts[use::3])

    def asked(self) -> LoopWindows:
        """Windows in which the set point moves: they alone tell how the law answers to it."""
        moves = np.abs(self.parts[..., 1]).max(axis=1) > 0
        return LoopWindows(self.moved[moves], self.parts[moves])

    def errors(self, numbers: Array) -> Array:
        """Sum of squared errors of the law with ``numbers`` (4,) in each window (W,)."""
        return np.asarray(np.sum((self.moved - self.parts @ numbers) ** 2, axis=1))

    def unexplained(self, numbers: Array) -> float:
        """Share of the movement that the law leaves: half of all movement lies in windows of at most this share."""
        size = np.sum(self.moved**2, axis=1)
        shares = self.errors(numbers) / size
        order = np.argsort(shares)
        half = np.searchsorted(np.cumsum(size[order]), 0.5 * size.sum())
        return float(shares[order][half])

    def fitted(self, basis: Sequence[Array]) -> Array:
        """The law's numbers (4,) by least squares, as a sum of ``basis``, (4,) each.

        Windows count alike, and those far off are left out: operators and limits move an MV too.
        """
        size = np.sqrt(np.sum(self.moved**2, axis=1))[:, None]
        mixed = np.stack(basis, axis=-1)
        moved, parts = self.moved / size, self.parts @ mixed / size[..., None]
        kept, numbers = np.ones(len(moved), dtype=bool), np.zeros(4)
        for _ in range(LEAVING_OUT_ROUNDS):
            scale = np.sqrt(np.mean(parts[kept] ** 2, axis=(0, 1)))
            scale[scale == 0] = 1.0
            flat = (parts[kept] / scale).reshape(-1, len(basis))
            numbers = mixed @ (np.linalg.lstsq(flat, moved[kept].ravel(), rcond=1e-10)[0] / scale)
            errors = self.errors(numbers) / size[:, 0] ** 2
            now = errors <= FAR_WINDOW * np.median(errors)
            if np.array_equal(now, kept):
                break
            kept = now
        return numbers


@dataclass(frozen=True, slots=True, eq=False)
class FittedForm:
    """One form of the law fitted on some windows, and what it leaves of others."""

    windows: LoopWindows
    basis: tuple[Array, ...]
    late: int
    numbers: Array
    unexplained: float  # of the windows for the choice, or of those in which the set point moves where that is more

    @classmethod
    def of(cls, windows: LoopWindows, basis: tuple[Array, ...], late: int) -> FittedForm:
        """Fitted on its third of the windows."""
        numbers, asked = windows.taken(FIT).fitted(basis), windows.asked()
        unexplained = windows.taken(CHOICE).unexplained(numbers)
        if len(asked.moved) >= FEWEST_ASKED:  # they may be few, and half of all movement lies without them
            unexplained = max(unexplained, asked.unexplained(numbers))
        return cls(windows, basis, late, numbers, unexplained)

    @property
    def share(self) -> float:
        """Share explained of the windows that had no part in fit and choice."""
        return 1 - self.windows.taken(SCORE).unexplained(self.numbers)

    def betters(self, other: FittedForm | None) -> bool:
        """Whether it leaves by far less than a plainer one; one that is not sound betters none."""
        return other is None or (self.sound and self.unexplained < BETTER_LOOP_FIT * other.unexplained)

    @property
    def sound(self) -> bool:
        """Whether all parts pull the same way, the set point no more than the PV."""
        kc, on_sp, integral, derivative = self.numbers
        return bool(kc * integral > 0 and derivative * kc >= 0 and -1e-9 <= on_sp / kc <= 1 + 1e-9)

    @property
    def integrates(self) -> bool:
        """Whether the MV shows an integral part; without it most of what is left would be there all the same."""
        rest = [part for part in self.basis if part is not _I]
        without = self.windows.taken(FIT).fitted(rest)
        score = self.windows.taken(SCORE)
        return score.unexplained(self.numbers) < BETTER_LOOP_FIT * score.unexplained(without)


def old_controllers(
    grid: Grid, code: NDArray[np.uint8], tags: Sequence[Tag], modes: Mapping[str, Sequence[str]]
) -> tuple[OldController, ...]:
    """The old law of each loop whose set point is known, with how far it is believed; arguments as ``operated``.

    Where no name tells which MV belongs to the set point, it is the MV that its law explains best.
    """
    found = []
    for loop in loops(grid, code, tags, modes):
        tried = [identified(grid, loop, mv) for mv in loop.own_mvs]
        found.append(max(tried, key=lambda law: (law.believed, law.share)))
    return tuple(found)


def identified(grid: Grid, loop: LoopRows, mv: Tag) -> OldController:
    """The law between a loop and one MV.

    The form is the plainest, and the window the longest, that no other betters by half.
    """
    rows = [grid.value[t.tag][loop.rows].astype(np.float64) for t in (loop.sp, loop.pv, mv)]
    piece = loop.piece if loop.automatic else _without_rests(rows[-1], loop.piece)
    if loop.manual:
        return _unknown(loop, mv, "the loop was in manual in all rows")
    best: FittedForm | None = None
    for length in LOOP_WINDOWS:
        late = [(n, w) for n in LATE_PV_ROWS if (w := _windows(rows, piece, grid.period_s, length, n, mv)).enough]
        own: FittedForm | None = None
        for forms in FORMS if late else ():
            one = min((FittedForm.of(w, form, n) for form in forms for n, w in late), key=lambda f: f.unexplained)
            own = one if one.betters(own) else own
        best = own if own is not None and own.betters(best) else best
    return _law(best, loop, mv)


def _unknown(loop: LoopRows, mv: Tag, why: str) -> OldController:
    signals = loop.pv.name, mv.name, loop.pv.unit, mv.unit
    return OldController(*signals, 0.0, 0.0, 0.0, 0.0, 0, 0, 0, 0.0, loop.same_name, why)


def _law(found: FittedForm | None, loop: LoopRows, mv: Tag) -> OldController:
    if found is None:
        few = f"{np.count_nonzero(loop.rows)} rows are too few in which the loop is at work and the MV moves"
        return _unknown(loop, mv, few)
    signals = loop.pv.name, mv.name, loop.pv.unit, mv.unit
    kc, on_sp, integral, derivative = (float(v) for v in found.numbers)
    return OldController(
        *signals,
        kc=kc,
        ti_s=kc / integral if integral else 0.0,
        td_s=abs(derivative / kc) if derivative else 0.0,
        set_point_weight=abs(on_sp / kc) if kc else 0.0,
        late_rows=found.late,
        rows=found.windows.moved.size,
        window_rows=found.windows.moved.shape[1],
        share=found.share,
        same_name=loop.same_name,
        doubt=_doubt(found),
    )


def _doubt(found: FittedForm) -> str:
    """Why the law is not believed, a clause; empty where it is."""
    if found.share < BELIEVED:
        return "set point and PV do not explain the MV: hand operation, a cascade or another law"
    if not found.sound:
        return "its parts would work against each other: something else moves the MV"
    return "" if found.integrates else "no integral part is seen"


def _without_rests(op: Array, piece: NDArray[np.int64]) -> NDArray[np.int64]:
    """The pieces (n,), cut up where an MV (n,) that moves at most rows rests: each such row is one of its own."""
    begins = np.flatnonzero(np.r_[True, (np.diff(op) != 0) | (np.diff(piece) != 0)])
    rests = np.diff(np.append(begins, len(op)))
    long = np.repeat(rests > max(MANUAL_REST, MANUAL_RESTS * float(np.median(rests))), rests)
    return np.asarray(np.cumsum(np.r_[True, (np.diff(piece) != 0) | long[1:] | long[:-1]]), dtype=np.int64)


def _windows(
    rows: Sequence[Array], piece: NDArray[np.int64], period_s: float, length: int, late: int, mv: Tag
) -> LoopWindows:
    """The windows of rows (n,) of set point, PV and MV, the PV ``late`` rows before the others."""
    sp, pv, op = rows
    begins = np.flatnonzero(np.r_[True, np.diff(piece) != 0])
    ends = np.append(begins[1:], len(piece))
    first = 1 + max(LATE_PV_ROWS)  # the parts of the first row look back so far
    starts = np.concatenate([np.arange(b + first, e - length, length) for b, e in zip(begins, ends, strict=True)])
    at = starts.astype(np.int64)[:, None] + np.arange(length)
    low = max(float(np.nanmin(op)), -np.inf if mv.low is None else mv.low)
    high = min(float(np.nanmax(op)), np.inf if mv.high is None else mv.high)
    slack = AT_MV_LIMIT * (high - low)
    moved = op[at]
    ended = ((moved <= low + slack) | (moved >= high - slack)).mean(axis=1)
    at = at[(np.ptp(moved, axis=1) > 0) & (ended <= MOST_AT_END) & np.isfinite(moved + pv[at] + sp[at]).all(axis=1)]
    y, r = pv[at - late], sp[at]
    e = r - y
    parts = [-y, r, period_s * np.cumsum(e, axis=1), (pv[at - late - 1] - y) / period_s]
    moved, stacked = op[at], np.stack(parts, axis=-1)
    return LoopWindows(moved - moved.mean(axis=1, keepdims=True), stacked - stacked.mean(axis=1, keepdims=True))
