"""A record beside an engineer's statements: one-step predictions of its rows agree, leave it open, or object."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from loopwright.pipeline.config.known import NONE, NOTHING, SURE, Known
from loopwright.pipeline.historian.direct import DirectModel
from loopwright.pipeline.records.record import Record

WINDOWS = ((20, 30), (40, 60), (60, 90))
"""Rows after a step over which an answer is taken; the last ones come nearest to the gain."""

SETTLED = 0.1
"""Share of an answer by which it may still change from the last window but one to the last where it has settled."""

MOST = 1e3
"""Change of a PV by a move of an input, both over their deviations: beyond it a model explodes and says nothing."""


@dataclass(frozen=True, slots=True)
class Beside:
    """A statement beside the record: the ``answer`` (value, standard deviation) [PV/input] that is most certain.

    None where the rows are too few, or where their model explodes. ``objection`` is the answer that contradicts the
    statement for certain; None where none does.
    """

    known: Known
    answer: tuple[float, float] | None = None
    objection: tuple[float, float] | None = None

    @property
    def question(self) -> str:
        """The question to ask; empty where nothing speaks against the statement."""
        return "" if self.objection is None else self.known.question(*self.objection)

    @property
    def agrees(self) -> bool:
        """Whether the record by itself is certain of the sign that is said."""
        return self.answer is not None and self.known.way * self.answer[0] >= SURE * self.answer[1]


def beside_record(known: Sequence[Known], record: Record) -> list[Beside]:
    """Each statement beside the record.

    A sign is contradicted by an answer that is certain to have the other one and keeps it in the last window; ``none``
    by one that is certain to be more than ``NOTHING``. A stated gain can only be too large for an answer that has not
    settled.
    """
    pvs, inputs = [s.name for s in record.pv_signals], [s.name for s in (*record.mv_signals, *record.dv_signals)]
    moves, found = np.hstack([record.mv, record.dv]), list[Beside]()
    for one in known:
        i, j = pvs.index(one.pv), inputs.index(one.input)
        model = DirectModel.of(record.pv[:, i], moves, record.run, WINDOWS[-1][1])
        unit = float(record.pv[:, i].std() / max(moves[:, j].std(), 1e-300))
        answers = [] if model is None else [model.answer_within(j, *rows, MOST * unit) for rows in WINDOWS]
        known_answers = [a for a in answers if a is not None]
        if not known_answers or answers[-1] is None:
            found.append(Beside(one))
            continue
        surest = max(known_answers, key=lambda a: abs(a[0]) / a[1])
        found.append(Beside(one, surest, _objection(one, known_answers, NOTHING * unit)))
    return found


def _objection(one: Known, answers: Sequence[tuple[float, float]], nothing: float) -> tuple[float, float] | None:
    """The answer that contradicts the statement; ``answers`` of the windows, the last one last."""
    last = answers[-1]
    if one.sign == NONE:
        return next((a for a in answers if one.excludes(*a, nothing)), None)
    other = [a for a in answers if one.way * a[0] < -SURE * a[1]]
    if other and one.way * last[0] < 0:
        return max(other, key=lambda a: abs(a[0]) / a[1])
    if one.gain is None or not one.excludes(*last):
        return None
    settled = len(answers) > 1 and abs(last[0] - answers[-2][0]) <= max(SETTLED * abs(last[0]), last[1])
    low, high = one.gains
    beyond = last[0] > max(high, 0.0) or last[0] < min(low, 0.0)  # further from 0 than any gain that is said
    return last if settled or beyond else None
