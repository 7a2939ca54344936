"""An engineer's knowledge of pairs of output and input: in the search for a model, beside model and record."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, TypeVar

import numpy as np

from loopwright.pipeline.config.known import CONTRADICTION_SDS, NO_ANSWER, NONE, Known, periods_of
from loopwright.pipeline.historian.stated_answers import Beside
from loopwright.pipeline.models.identified.dynamics import Dynamics
from loopwright.pipeline.models.identified.scaled_record import ScaledRecord, Scales
from loopwright.pipeline.models.identified.steady_states import central_gain
from loopwright.pipeline.plants.simulator import Array
from loopwright.pipeline.records.record import Record

Model = TypeVar("Model", bound=Dynamics)
Against = frozenset[int]
"""Numbers of the pairs of which a model contradicts what is known."""


@dataclass(frozen=True, slots=True)
class Pair:
    """A statement on ``output`` and ``input``: gains from ``low`` to ``high`` in scaled numbers, delays in periods.

    ``none``: the input does not move the output. ``delays`` None: nothing is known of the dead time.
    """

    output: int
    input: int
    low: float
    high: float
    none: bool = False
    delays: tuple[int, int] | None = None


@dataclass(frozen=True, slots=True)
class Knowledge:
    """The statements on the ``n_y`` outputs of a model; empty where nothing is known, and then nothing is done."""

    pairs: tuple[Pair, ...] = ()
    n_y: int = 0

    @classmethod
    def of(
        cls, known: Sequence[Known], pvs: Sequence[str], inputs: Sequence[str], scales: Scales, period_s: float
    ) -> Knowledge:
        """From statements on signals by name; those on PVs that are no output of the model say nothing of it."""
        pairs = []
        for one in (k for k in known if k.pv in pvs):
            i, j = pvs.index(one.pv), inputs.index(one.input)
            low, high = (end * float(scales.v_scale[j] / scales.y_scale[i]) for end in one.gains)
            delays = None if one.dead_s is None else periods_of(one, period_s)
            pairs.append(Pair(i, j, low, high, one.sign == NONE, delays))
        return cls(tuple(pairs), len(pvs))

    def delays(self, offered: Sequence[int]) -> tuple[int, ...]:
        """Delays (n_v,) moved into what is known of the dead times.

        An input has one delay for all outputs: no output may answer later than it is known to, and where the dead time
        of one is not known, it may answer at once.
        """
        found = list(offered)
        for j in range(len(found)):
            pairs = [p for p in self.pairs if p.input == j]
            spans = [p.delays for p in pairs if p.delays is not None]
            if spans:
                least = min(first for first, _ in spans) if len(spans) + sum(p.none for p in pairs) == self.n_y else 0
                found[j] = min(max(found[j], least), min(last for _, last in spans))
        return tuple(found)

    @property
    def silent(self) -> list[int]:
        """Inputs that move no output."""
        none = [p.input for p in self.pairs if p.none]
        return [j for j in dict.fromkeys(none) if none.count(j) == self.n_y]

    def heard(self, data: ScaledRecord) -> ScaledRecord:
        """The rows, inputs that move no output at 0: no fit can make use of them."""
        if not self.silent:
            return data
        v = data.v.copy()
        v[:, self.silent] = 0.0
        return replace(data, v=v)

    def weights(self, sd: Array) -> Array:
        """Deviations (n_v,) of the inputs as weights of an impulse response: 1 of those that move no output."""
        if not self.silent:
            return sd
        found = sd.copy()
        found[self.silent] = 1.0
        return found

    def without(self, response: Array) -> Array:
        """An impulse response (length, n_y, n_v), 0 of the pairs without an effect."""
        if not any(p.none for p in self.pairs):
            return response
        found = response.copy()
        for p in self.pairs:
            if p.none:
                found[:, p.output, p.input] = 0.0
        return found

    def lagged(self, model: Dynamics, y_lags: int) -> Dynamics:
        """A model in companion form without the coefficients of the pairs that have no effect."""
        if not any(p.none for p in self.pairs):
            return model
        a, b = model.a.copy(), model.b.copy()
        for p in self.pairs:
            if p.none:
                b[p.output, p.input] = 0.0
                a[p.output, y_lags * self.n_y + p.input :: model.n_v] = 0.0
        return replace(model, a=a, b=b)

    def quiet(self, model: Model) -> Model:
        """The model without what inputs that move no output could do in it."""
        if not self.silent:
            return model
        b, w1 = model.b.copy(), model.w1.copy()
        b[:, self.silent] = 0.0
        w1[:, [model.n_x + j for j in self.silent]] = 0.0
        return replace(model, b=b, w1=w1)

    def against(self, model: Dynamics, data: ScaledRecord) -> Against:
        """The pairs whose steady gain at the middle of the data contradicts what is known.

        The slope of an output that integrates stands for the gain, and its sign alone is compared.
        """
        if not self.pairs:
            return frozenset()
        gain, integrates = central_gain(model, data)
        size, found = data.v.std(axis=0), set[int]()
        for k, p in enumerate(self.pairs):
            low, high = p.low, p.high
            if p.none:
                low, high = -NO_ANSWER / max(size[p.input], 1e-300), NO_ANSWER / max(size[p.input], 1e-300)
            elif integrates:
                low, high = (0.0 if low >= 0 else -np.inf), (0.0 if high <= 0 else np.inf)
            value = gain[p.output, p.input]
            if value < low or value > high:
                found.add(k)
        return frozenset(found)


NOTHING_KNOWN = Knowledge()


# ------------------------------------------------------------------------------ beside the fitted model and the record
AGREES, OPEN, MODEL, CONTRADICTED, UNUSED = "agrees", "open", "model", "contradicted", "unused"


@dataclass(frozen=True, slots=True)
class ModelDelay:
    """The delay of an input before the model's states, ``periods``, and the least and most as ``likely`` [periods].

    None where no others were compared. ``first_answers`` are the periods after which each PV first moves, None where it
    never does: one more than the delay of a state that answers at once.
    """

    periods: int
    likely: tuple[int, int] | None = None
    first_answers: Mapping[str, int | None] = field(default_factory=dict)


def known_figures(
    statements: Sequence[Beside],
    gains: Mapping[str, Mapping[str, Mapping[str, Any]]],
    record: Record,
    delays: Mapping[str, ModelDelay],
) -> list[dict[str, Any]]:
    """For each statement: what it ``says``, the sign ``way`` of it, whether it has a ``size``, and a ``verdict``.

    A dead time has a row of its own, with ``dead_s``, see ``_dead_row``; ``delays`` are those of the inputs.

    ``contradicted``: the record is certain of another sign or gain; ``question`` then says what to ask. ``model``: the
    model has another one, and the record is not certain. ``open``: nor does the record say so, and the statement
    decides. ``agrees``: it is certain of the same sign. ``unused``: of a PV that is no output of the model.

    ``gain`` and ``spread`` are the model's, as in ``gains`` of ``gain_figures``, ``direct`` and ``sd`` those of the
    answer that one-step predictions of the record are most certain of [PV/input].
    """
    found = []
    for beside in statements:
        one = beside.known
        if one.says_gain:
            found.append(_gain_row(beside, gains, record))
        if one.dead_s is not None:
            delay = delays[one.input] if one.pv in gains else None
            found.append(_dead_row(beside, one.dead_s, delay))
    return found


def _gain_row(beside: Beside, gains: Mapping[str, Mapping[str, Mapping[str, Any]]], record: Record) -> dict[str, Any]:
    """The row of a statement on sign or gain."""
    one = beside.known
    row: dict[str, Any] = {"pv": one.pv, "input": one.input, "says": one.says_gain}
    row |= {"way": one.way, "size": one.gain is not None}
    if one.pv not in gains:
        return {**row, "verdict": UNUSED}
    of = gains[one.pv][one.input]
    direct, sd = beside.answer or (None, None)
    row |= {"gain": of["gain"], "spread": of["spread"], "rate": of["rate"], "direct": direct, "sd": sd}
    if beside.question:
        return {**row, "verdict": CONTRADICTED, "question": beside.question}
    if _other(one, of, _nothing(one, record)):
        return {**row, "verdict": MODEL}
    return {**row, "verdict": AGREES if beside.agrees and one.way else OPEN}


def _dead_row(beside: Beside, dead_s: tuple[float, float], delay: ModelDelay | None) -> dict[str, Any]:
    """The row of a stated dead time ``dead_s`` [s]: it has no sign, and ``verdict`` and ``question`` as others have.

    ``model_s`` [s] is the model's delay before its states, ``answer_s`` [s] the time from a move to the PV's first
    answer, as everywhere, ``likely_s`` the least and most delay of models as likely, and ``record_s`` those that the
    record by itself leaves; its most is None where no answer is certain. Slow states hide a dead time, so that it lies
    anywhere from the delay up to the period before the first answer: the model contradicts what is said outside of it.
    """
    one, period_s = beside.known, beside.period_s
    row: dict[str, Any] = {"pv": one.pv, "input": one.input, "says": one.says_dead, "way": 0, "size": False}
    row |= {"dead_s": list(dead_s)}
    if delay is None:
        return {**row, "verdict": UNUSED}
    likely = None if delay.likely is None else [periods * period_s for periods in delay.likely]
    left = None if beside.dead is None else list(beside.dead_s)
    answer = delay.first_answers.get(one.pv)
    row |= {"model_s": delay.periods * period_s, "likely_s": likely, "record_s": left}
    row |= {"answer_s": None if answer is None else answer * period_s}
    if beside.dead_objects:
        return {**row, "verdict": CONTRADICTED, "question": beside.dead_question}
    first, last = periods_of(one, period_s)
    if delay.periods > last or (answer is not None and answer - 1 < first):
        return {**row, "verdict": MODEL}
    return {**row, "verdict": AGREES if beside.dead_agrees else OPEN}


def _other(one: Known, of: Mapping[str, Any], nothing: float) -> bool:
    """Whether the model itself has another sign or gain, beyond how its fits differ; of a rate its sign alone."""
    if one.way * of["gain"] < 0 or of["rate"]:
        return bool(one.way * of["gain"] < 0)
    return one.excludes(of["gain"], of["spread"] / CONTRADICTION_SDS, nothing if one.sign == NONE else 0.0)


def _nothing(one: Known, record: Record) -> float:
    """The gain [PV/input] below which an input has no effect in the record."""
    signals = [(s.name, v) for group in ("pv", "mv", "dv")
               for s, v in zip(getattr(record, f"{group}_signals"), getattr(record, group).T, strict=True)]  # fmt: skip
    sd = {name: float(values.std()) for name, values in signals}
    return NO_ANSWER * sd[one.pv] / max(sd[one.input], 1e-300)
