"""Can these rows carry a model: moves of the inputs, answers of the PVs, correlation, feedback."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations, combinations_with_replacement, pairwise

import numpy as np
from numpy.typing import NDArray

from loopwright.pipeline.historian.answers import first_answer
from loopwright.pipeline.historian.arx_model import Linear
from loopwright.pipeline.historian.cleaning.findings import InputReport, RecordJudgement, counted
from loopwright.pipeline.historian.feedback import follows
from loopwright.pipeline.historian.files.signal_statistics import HELD_ROWS
from loopwright.pipeline.historian.settling import certain
from loopwright.pipeline.metrics import Array
from loopwright.pipeline.records.record import Record
from loopwright.serving.manifest import Signal

# --------------------------------------------- power of an input against the plant's band, and its coherence with a PV
SEGMENT_SETTLINGS = 4  # of a segment
SHORTEST_SEGMENT, LONGEST_SEGMENT = 64, 4096  # rows of a segment
SEGMENTS = 4  # at least, for a coherence
MOST_SPECTRUM_ROWS = 60_000  # rows
PLANT_BAND = (0.1, 3.0)  # of the plant's corner frequency


@dataclass(frozen=True, slots=True, eq=False)
class Spectrum:
    """Spectra of one input and one PV over frequencies f (m,) [1/row]: shares of the input's power, and the coherence.

        coherence(f) = |P_uy|^2 / (P_uu P_yy),   P = S^-1

    with S the spectral matrix of all inputs and the PV: the partial coherence, 1 where the PV follows this input
    linearly and without noise once the other inputs' part is taken off.
    """

    frequency: Array
    power: Array  # (m,) of the input, sums to 1
    coherence: Array  # (m,)
    band: tuple[float, float]  # [1/row] of the plant: PLANT_BAND times the corner 3 / (2 pi settling)

    @property
    def inside(self) -> NDArray[np.bool_]:
        """Frequencies (m,) of the plant's band; the nearest one where none lies in it."""
        inside = (self.frequency >= self.band[0]) & (self.frequency <= self.band[1])
        if not inside.any():
            inside = np.abs(self.frequency - self.band[0]) <= np.min(np.abs(self.frequency - self.band[0]))
        return inside

    @property
    def band_share(self) -> float:
        """Share of the input's power in the plant's band."""
        return float(self.power[self.inside].sum())

    @property
    def band_coherence(self) -> float:
        """Median coherence in the plant's band, where the input has power."""
        inside = self.inside & (self.power >= 1e-3 * self.power.max())
        return float(np.median(self.coherence[inside])) if inside.any() else 0.0


def spectra(u: Array, y: Array, run: NDArray[np.int64], settling: Sequence[int]) -> list[Spectrum] | None:
    """The spectrum of each input of u (n, m) and of y (n,), from the runs that hold a segment.

    ``settling`` [rows] of the answer to each input. None where too few segments fit for the coherences.
    """
    from scipy.signal import csd

    n, m = min(len(u), MOST_SPECTRUM_ROWS), u.shape[1]
    length = int(np.clip(SEGMENT_SETTLINGS * max(settling), SHORTEST_SEGMENT, LONGEST_SEGMENT))
    edges = np.r_[0, np.flatnonzero(np.diff(run[:n])) + 1, n]
    parts = [(int(a), int(b)) for a, b in pairwise(edges) if b - a >= length]
    if sum(2 * (b - a) // length - 1 for a, b in parts) < SEGMENTS + 2 * m:
        return None
    z = np.column_stack([u[:n], y[:n]])
    scale = z.std(axis=0)
    if not np.all(scale > 0):
        return None
    z = z / scale
    frequency = np.asarray(np.fft.rfftfreq(length), dtype=np.float64)
    cross = np.zeros((len(frequency), m + 1, m + 1), dtype=np.complex128)
    for a, b in parts:
        for i, j in combinations_with_replacement(range(m + 1), 2):
            own = csd(z[a:b, i], z[a:b, j], nperseg=length, detrend="constant")[1] * (b - a)
            cross[:, i, j] += own
            if i != j:
                cross[:, j, i] += own.conj()
    return [_of_input(frequency[1:], cross[1:], i, settling[i]) for i in range(m)]


def _of_input(frequency: Array, cross: NDArray[np.complex128], i: int, settling: int) -> Spectrum:
    power = np.abs(cross[:, i, i])
    ridge = 1e-9 * np.trace(cross, axis1=1, axis2=2).real[:, None, None] * np.eye(cross.shape[1])
    inverse = np.linalg.inv(cross + ridge)
    square = np.abs(inverse[:, i, -1]) ** 2 / np.maximum(np.abs(inverse[:, i, i] * inverse[:, -1, -1]), 1e-300)
    corner = 3.0 / (2 * np.pi * max(settling, 1))
    band = (PLANT_BAND[0] * corner, min(PLANT_BAND[1] * corner, 0.5))
    return Spectrum(frequency, power / max(float(power.sum()), 1e-300), np.clip(square, 0.0, 1.0), band)


# --------------------------------------------------------------------------------------------------------- the verdict
Runs = NDArray[np.int64]

MOVE_SHARE = 0.02  # of an input's own span: a move that counts
FEW_MOVES, ENOUGH_MOVES = 6, 20  # of an input: fewer are a question, and as many are wanted
SEEN_STRENGTH = 4.0  # strength of an answer
FEEDBACK_SHARE, FOLLOWS_CLOSELY = 0.15, 0.9  # share of the moves that the PVs' past explains
ALIKE_INPUTS, SAME_INPUTS = 0.9, 0.98  # correlation of two inputs
NARROW_MV = 0.05  # of an MV's range
ROWS_A_PARAMETER, LEAST_ROWS_A_PARAMETER = 20, 4  # rows that are wanted, and below which there are too few
IN_BAND = 0.1  # share of an input's power in the plant's band
COHERENT_ANSWER = 0.3  # coherence in the band
LONG_DELAY, LEAST_DELAY = 1.0, 20  # dead time over what follows it, and rows
UNKNOWN_SETTLING = 30  # rows, where no answer is seen
OUT_OF_RANGE = 0.1  # share of the rows dropped for it, from which the record is doubtful


def moves_of(u: Array, run: Runs) -> Array:
    """Sizes of the moves of an input u (n,), each at least MOVE_SHARE of its span.

    A move goes from one turning point to the next; in a record of steps each step is one.
    """
    span = float(np.ptp(u)) if len(u) else 0.0
    if span <= 0:
        return np.zeros(0)
    inside = run[1:] == run[:-1]
    step = np.diff(u)[inside]
    if np.mean(np.abs(step) <= 1e-9 * span) >= HELD_ROWS:
        return np.abs(step[np.abs(step) >= MOVE_SHARE * span])
    # Ends of a rise or fall; small reversals belong to it.
    sizes, pivot, extreme, way = [], float(u[0]), float(u[0]), 0
    reversal = max(MOVE_SHARE, 0.05) * span
    for v in u.tolist():
        if (way >= 0 and v > extreme) or (way <= 0 and v < extreme):
            extreme, way = v, (1 if v > pivot else -1)
        elif abs(v - extreme) >= reversal:
            sizes.append(abs(extreme - pivot))
            pivot, extreme, way = extreme, v, (1 if v > extreme else -1)
    sizes.append(abs(extreme - pivot))
    return np.array([s for s in sizes if s >= reversal])


def judged(
    record: Record, models: Mapping[str, Linear | None], moved_sp: int, rows: int, drifts: Collection[str] = ()
) -> RecordJudgement:
    """The verdict over a record of ``rows`` rows, or an excerpt of it.

    ``models`` are the quick ones by PV, ``moved_sp`` the moves of the set points, ``drifts`` PVs with slow motion
    that the inputs do not explain.
    """
    signals = [(s, "mv") for s in record.mv_signals] + [(s, "dv") for s in record.dv_signals]
    u = np.hstack([record.mv, record.dv])
    found = spectra_of(record, models)
    settling = {n: _settling(m, len(signals)) for n, m in models.items() if m}
    pvs = dict(zip((s.name for s in record.pv_signals), record.pv.T, strict=True))
    sure = {
        n: certain(pvs[n], list(u.T), record.run, {i: rows for i, rows in of.items() if rows})
        for n, of in settling.items()
    }
    inputs = [
        _input(record, models, i, signal, role, u[:, i], {n: s[i] for n, s in found.items()}, sure)
        for i, (signal, role) in enumerate(signals)
    ]
    correlation = _correlation(u, [s.name for s, _ in signals])
    parameters = 3 * len(record.pv_signals) + 7 * len(signals) + 1
    used = max((len(m.rows) for m in models.values() if m), default=0)
    reasons, level = _reasons(record, inputs, correlation, parameters, moved_sp, rows)
    unsure = tuple(n for n, m in models.items() if n in drifts and m is not None and _unsure(n, m, inputs))
    if unsure:
        words = "are unreliable: drift or loads look like a slow answer"
        reasons.append(f"gain and settling time of {', '.join(unsure)} {words}")
        level = max(level, 1)
    carries = ("yes", "doubtful", "no")[level]
    return RecordJudgement(carries, tuple(reasons), tuple(inputs), correlation, rows, parameters, used, unsure)


def _unsure(pv: str, model: Linear, inputs: list[InputReport]) -> bool:
    """Whether the gain and settling time of a PV that drifts may come from the drift, or from loads that wander."""
    seen = [i for i in inputs if i.role == "mv" and i.answers[pv] > SEEN_STRENGTH]
    unconfirmed = bool(seen) and not model.integrates and not any(pv in i.certain for i in seen)
    return unconfirmed or not model.sure


def with_rows_out_of_range(verdict: RecordJudgement, dropped: int, rows: int) -> RecordJudgement:
    """The verdict, "doubtful" at best where many rows were dropped because a reading left a range that was given.

    The rest is the plant inside the range, and every excursion is torn out of its course.
    """
    if dropped <= OUT_OF_RANGE * rows:
        return verdict
    words = (
        f"{100 * dropped / rows:.0f} % of the rows have a reading outside the range that was given: widen the range if "
        "the plant goes there, or correct the unit"
    )
    carries = verdict.carries if verdict.carries == "no" else "doubtful"
    return replace(verdict, carries=carries, reasons=(*verdict.reasons, words))


def spectra_of(record: Record, models: Mapping[str, Linear | None]) -> dict[str, list[Spectrum]]:
    """The spectra of all inputs, MVs first, by PV; a PV of which the record is too short for them is left out."""
    u = np.hstack([record.mv, record.dv])
    found = {}
    for (name, model), y in zip(models.items(), record.pv.T, strict=True):
        settling = [
            (model.settling(i) if model and model.strength[i] > SEEN_STRENGTH else 0) or UNKNOWN_SETTLING
            for i in range(u.shape[1])
        ]
        own = spectra(u, y, record.run, settling)
        if own is not None:
            found[name] = own
    return found


def _input(
    record: Record,
    models: Mapping[str, Linear | None],
    i: int,
    signal: Signal,
    role: str,
    u: Array,
    known: Mapping[str, Spectrum],
    certain_of: Mapping[str, Collection[int]],
) -> InputReport:
    """Report on input ``i`` with the values u (n,) and on what answers; ``certain_of``: PV -> some settling times."""
    moves = moves_of(u, record.run)
    span = float(np.ptp(u)) if len(u) else 0.0
    still = np.abs(np.diff(u)) <= 1e-9 * span if span > 0 else np.ones(max(len(u) - 1, 1))
    held = float(np.mean(still))
    pvs = dict(zip((s.name for s in record.pv_signals), record.pv.T, strict=True))
    answers = {n: m.strength[i] if m else 0.0 for n, m in models.items()}
    seen = {n: m for n, m in models.items() if m and answers[n] > SEEN_STRENGTH}
    settling = {n: m.settling(i) for n, m in seen.items()}
    sure = tuple(n for n in settling if i in certain_of[n])
    # Between an analyser's readings nobody knows when an answer begins.
    seldom = {record.pv_signals[i].name for i in record.seldom}
    quick = {n: y for n, y in pvs.items() if n not in seldom}
    first = {n: first_answer(y, u, record.run) for n, y in quick.items()} if held >= HELD_ROWS else {}
    median, largest = (float(np.median(moves)), float(moves.max())) if moves.size else (0.0, 0.0)
    return InputReport(
        name=signal.name,
        role=role,
        unit=signal.unit,
        low=signal.low,
        high=signal.high,
        moves=len(moves),
        median_move=median,
        largest_move=largest,
        held_share=held,
        answers=answers,
        follows={n: follows(u, y, record.run) for n, y in pvs.items()} if role == "mv" else {},
        settling_s=max((settling[n] for n in sure), default=0) * record.period_s,
        uncertain_s=max((rows for n, rows in settling.items() if n not in sure), default=0) * record.period_s,
        certain=sure,
        first_answer_s={n: k.last * record.period_s for n, k in first.items() if k},
        against=tuple(n for n, k in first.items() if k and k.feedback) if role == "mv" else (),
        first_possible_s={n: k.first * record.period_s for n, k in first.items() if k},
        gain={n: _gain(seen[n], i) if n in seen else 0.0 for n in pvs},
        rate={n: m.slope(i) * 60 / record.period_s for n, m in seen.items() if m.integrates and m.ramps(i)},
        band_share=max((s.band_share for s in known.values()), default=-1.0),
        coherence={n: s.band_coherence for n, s in known.items()},
    )


def _settling(model: Linear, n: int) -> dict[int, int]:
    """Rows in which the PV settles after each of n inputs that it answers to; 0 where it does not."""
    return {i: model.settling(i) for i in range(n) if model.strength[i] > SEEN_STRENGTH}


def _gain(model: Linear, i: int) -> float:
    """The answer's last value; 0 where it does not settle."""
    return float(model.step_response(i)[-1]) if model.settling(i) else 0.0


def _reasons(
    record: Record, inputs: list[InputReport], correlation: Mapping[str, float], parameters: int, moved_sp: int, n: int
) -> tuple[list[str], int]:
    found: list[tuple[int, str]] = []
    wanted = ROWS_A_PARAMETER * parameters
    if n < wanted:
        few = ": too few" if n < LEAST_ROWS_A_PARAMETER * parameters else " are few"
        words = f"{n} rows for {parameters} parameters of a linear model{few}; record {wanted} or more"
        found.append((1 + (n < LEAST_ROWS_A_PARAMETER * parameters), words))
    for i, values in zip((i for i in inputs if i.role == "mv"), record.mv.T, strict=True):
        span = float(np.ptp(values)) if n else 0.0
        moved = f"{i.name} made {i.moves} moves of {100 * MOVE_SHARE:g} % of its span or more"
        if i.moves < FEW_MOVES:
            found.append((2, f"{moved}: too few"))
        elif i.moves < ENOUGH_MOVES:
            found.append((1, f"{moved}; {ENOUGH_MOVES} are wanted"))
        if i.moves >= FEW_MOVES and not _answered(i):
            words = f"no process variable answers to {i.name}: check the tag, its times, and the PVs"
            if any(s > FEEDBACK_SHARE for s in i.follows.values()):
                words += f"; {i.name} answers to a PV instead: are the two swapped, or is it a controller's output"
            found.append((2, words))
        if i.against:
            words = "feedback, by hand or by a controller, and no late column; no doubt by itself"
            found.append((0, f"{i.name} is moved against what {', '.join(i.against)} did before: {words}"))
        found += _band_and_delay(i, record.period_s)
        if 0 < span < NARROW_MV * (i.high - i.low):
            found.append((1, f"{i.name} moved over {100 * span / (i.high - i.low):.1f} % of its range"))
        followed = {pv: s for pv, s in i.follows.items() if s > FEEDBACK_SHARE}
        if followed and i.held_share < HELD_ROWS:
            pv, share = max(followed.items(), key=lambda item: item[1])
            words = f"{i.name} follows {pv} (feedback explains {100 * share:.0f} % of its moves)"
            alone = moved_sp < FEW_MOVES
            if alone:
                few = f"the set points were moved {counted(moved_sp, 'time')} only"
                moved = few if moved_sp else "no set point was moved"
                words += f", and {moved}: the record shows the controller more than the plant"
            found.append((2 if alone and share > FOLLOWS_CLOSELY else 1 if alone else 0, words))
    for pair, r in correlation.items():
        if abs(r) > ALIKE_INPUTS:
            end = ": their effects cannot be told apart" if abs(r) > SAME_INPUTS else ""
            found.append((2 if abs(r) > SAME_INPUTS else 1, f"{pair} move together (correlation {r:.2f}){end}"))
    return [words for _, words in sorted(found, key=lambda f: -f[0])], max((level for level, _ in found), default=0)


def _answered(i: InputReport) -> bool:
    return any(a > SEEN_STRENGTH for a in i.answers.values()) or bool(i.first_answer_s)


def _band_and_delay(i: InputReport, period_s: float) -> list[tuple[int, str]]:
    found = []
    if 0 <= i.band_share < IN_BAND:
        found.append((1, f"{i.name} moves slower or faster than the plant answers: {100 * i.band_share:.0f} % of its "
                         "motion lies in the plant's band"))  # fmt: skip
    if i.coherence and _answered(i) and max(i.coherence.values()) < COHERENT_ANSWER:
        pv, share = max(i.coherence.items(), key=lambda item: item[1])
        found.append((1, f"{pv} owes {100 * share:.0f} % of its motion to {i.name} (coherence in the plant's band): "
                         "noise, other causes, or a strong nonlinearity"))  # fmt: skip
    for pv, after in i.first_answer_s.items():
        if abs(after) < 0.5 * period_s:
            found.append((1, f"{pv} answers in the row in which {i.name} moves: its column is late, or a row is long "
                             "beside the dead time"))  # fmt: skip
        elif after < 0:
            found.append((1, f"{pv} answers before {i.name} moves, by {-after:g} s or more: its column is late"))
        waits = after > LONG_DELAY * (i.settling_s - after) and pv not in i.rate  # an integrator never settles
        if after >= LEAST_DELAY * period_s and waits:
            found.append(
                (1, f"{pv} answers to {i.name} only after {after:g} s: a long dead time, or clocks that differ")
            )
    return found


def _correlation(u: Array, names: list[str]) -> dict[str, float]:
    if len(u) < 3:
        return {}
    moving = np.ptp(u, axis=0) > 0
    found = {}
    for i, j in combinations(range(len(names)), 2):
        if moving[i] and moving[j]:
            found[f"{names[i]} and {names[j]}"] = float(np.corrcoef(u[:, i], u[:, j])[0, 1])
    return found
