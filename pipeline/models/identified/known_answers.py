"""An engineer's knowledge of the plant beside the fitted model, and beside the record that it is fitted to."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from loopwright.pipeline.config.known import NONE, NOTHING, SURE, Known
from loopwright.pipeline.historian.answers import Beside
from loopwright.pipeline.records.record import Record

AGREES, OPEN, MODEL, CONTRADICTED, UNUSED = "agrees", "open", "model", "contradicted", "unused"


def known_figures(
    statements: Sequence[Beside], gains: Mapping[str, Mapping[str, Mapping[str, Any]]], record: Record
) -> list[dict[str, Any]]:
    """For each statement: what it ``says``, the sign ``way`` of it, whether it has a ``size``, and a ``verdict``.

    ``contradicted``: the record is certain of another sign or gain; ``question`` then says what to ask. ``model``: the
    model has another one, and the record is not certain. ``open``: nor does the record say so, and the statement
    decides. ``agrees``: it is certain of the same sign. ``unused``: of a PV that is no output of the model.

    ``gain`` and ``spread`` are the model's, as in ``gains`` of ``gain_figures``, ``direct`` and ``sd`` those of the
    answer that one-step predictions of the record are most certain of [PV/input].
    """
    found = []
    for beside in statements:
        one = beside.known
        row: dict[str, Any] = {"pv": one.pv, "input": one.input, "says": one.says}
        row |= {"way": one.way, "size": one.gain is not None}
        if one.pv not in gains:
            found.append({**row, "verdict": UNUSED})
            continue
        of = gains[one.pv][one.input]
        direct, sd = beside.answer or (None, None)
        row |= {"gain": of["gain"], "spread": of["spread"], "rate": of["rate"], "direct": direct, "sd": sd}
        if beside.question:
            found.append({**row, "verdict": CONTRADICTED, "question": beside.question})
        elif _other(one, of, _nothing(one, record)):
            found.append({**row, "verdict": MODEL})
        else:
            found.append({**row, "verdict": AGREES if beside.agrees and one.way else OPEN})
    return found


def _other(one: Known, of: Mapping[str, Any], nothing: float) -> bool:
    """Whether the model itself has another sign or gain, beyond how its fits differ; of a rate its sign alone."""
    if one.way * of["gain"] < 0 or of["rate"]:
        return bool(one.way * of["gain"] < 0)
    return one.excludes(of["gain"], of["spread"] / SURE, nothing if one.sign == NONE else 0.0)


def _nothing(one: Known, record: Record) -> float:
    """The gain [PV/input] below which an input has no effect in the record."""
    signals = [(s.name, v) for group in ("pv", "mv", "dv")
               for s, v in zip(getattr(record, f"{group}_signals"), getattr(record, group).T, strict=True)]  # fmt: skip
    sd = {name: float(values.std()) for name, values in signals}
    return NOTHING * sd[one.pv] / max(sd[one.input], 1e-300)
