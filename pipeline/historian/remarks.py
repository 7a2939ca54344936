"""What is named and not dropped: compression, coarse steps, a shifted MV, drift."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from pipeline.historian.cells import noise_sd, usual
from pipeline.historian.character import quantum, straight_share
from pipeline.historian.excitation import HELD
from pipeline.historian.export import Series
from pipeline.historian.findings import Finding
from pipeline.historian.grid import Sampling
from pipeline.historian.linear import Linear
from pipeline.metrics import Array
from pipeline.records.record import Record

COARSE = 0.002  # of the usual span: a converter's step that a model feels
STRAIGHT = 0.3  # share of rows in straight lines, from which a signal was compressed
PARTS, DRIFT_SE, DRIFT_SPAN = 8, 6.0, 0.1
AHEAD = 25.0  # strength of moves still to come


def of_series(series: Series, rate: Sampling) -> list[Finding]:
    """Compression, exception reporting and coarse steps of one tag."""
    if series.categories:
        return []
    found = []
    values = series.value[series.good]
    low, high = usual(values)
    span = high - low
    if rate.irregular:
        kind = "by exception, beyond a dead band" if rate.dead_band else "by exception, or compressed (swinging door)"
        words = (
            f"stored {kind}: a reading every {rate.step_s:.4g} s in the median; used for at most {rate.hold_s:.4g} s"
        )
        found.append(Finding("compression", series.tag, words))
    elif (share := straight_share(values)) > STRAIGHT:
        words = (
            f"{100 * share:.0f} % of the readings lie on straight lines: interpolated from compressed data (swinging "
            "door); what lies between was never stored, export raw data"
        )
        found.append(Finding("compression", series.tag, words))
    step = quantum(values)
    if span > 0 and step > COARSE * span:
        noise = noise_sd(values)
        words = f"moves in steps of {step:.4g}, {100 * step / span:.2g} % of its span"
        words += ", more than its noise" if step > 2 * noise else ""
        found.append(Finding("quantization", series.tag, words))
    return found


def of_models(record: Record, models: Mapping[str, Linear | None]) -> list[Finding]:
    """Moves that a PV answers before they happen, and offsets that wander; both from the quick linear models."""
    found = []
    for i, signal in enumerate(record.mv_signals):
        span = max(float(np.ptp(record.mv[:, i])), 1e-300)
        held = float(np.mean(np.abs(np.diff(record.mv[:, i])) <= 1e-9 * span))
        early = {name: m.ahead[i] for name, m in models.items() if m is not None and m.ahead[i][0] > AHEAD}
        # In a loop the MV follows the PV at every row; an MV that holds does not know what comes.
        if early and held >= HELD:
            lead = max(early.values())[1]
            words = (
                f"{', '.join(early)} answers about {lead} row{'s' if lead > 1 else ''} before {signal.name} moves: the "
                f"export stores {signal.name} late, or an operator moves it at once when the other changes"
            )
            found.append(Finding("shifted", signal.name, words))
    for (name, model), y in zip(models.items(), record.pv.T, strict=True):
        if model is not None:
            found += _drift(name, model, float(np.ptp(np.quantile(y, [0.01, 0.99]))))
    return found


def _drift(name: str, model: Linear, span: float) -> list[Finding]:
    """Levels, over PARTS of the record, of what the inputs leave unexplained; their error counts its slow noise."""
    rest = model.unexplained
    if len(rest) < 40 * PARTS:
        return []
    level = np.array([p.mean() for p in np.array_split(rest, PARTS)])
    own = np.concatenate([p - p.mean() for p in np.array_split(rest, PARTS)])
    error = float(own.std()) * np.sqrt(2 * _memory(own) * PARTS / len(rest))
    change = float(np.ptp(level))
    if change > DRIFT_SE * error and change > DRIFT_SPAN * span:
        words = (
            f"drifts: what the inputs do not explain moves by {change:.4g}, {100 * change / span:.0f} % of its span, "
            "over the record; unmeasured loads or a changing plant"
        )
        return [Finding("drift", name, words)]
    return []


def _memory(values: Array) -> float:
    """Rows after which the autocorrelation has fallen to 1/e, at least 1."""
    size = 1 << (2 * len(values) - 1).bit_length()
    power = np.abs(np.fft.rfft(values, size)) ** 2
    correlation = np.fft.irfft(power, size)[: len(values) // 2]
    below = np.flatnonzero(correlation < correlation[0] / np.e)
    return float(max(below[0] if below.size else len(values) // 2, 1))
