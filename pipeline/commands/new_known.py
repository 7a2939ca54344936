"""``loopwright new``: what a person knows of pairs of PV and input, by ``--known`` and by column ``known`` of the table."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from pipeline.config.known import FORMS, NONE, NOTHING, Known, stated, together
from pipeline.config.plants import mistake_of_known
from pipeline.errors import RecordError, nearest
from pipeline.historian.direct import DirectModel
from pipeline.historian.findings import Verdict
from pipeline.historian.tags import Tag, TableError
from pipeline.plants.simulator import Simulator
from pipeline.records.record import Record

FEWEST, USUAL, MOST = 10, 40, 100  # rows after a step in which an answer is looked for; USUAL: the record does not say


@dataclass(frozen=True, slots=True)
class Stated:
    """The statements, one a pair, and the pairs (PV, input) of which ``--known PV/INPUT=`` takes an earlier one back."""

    known: tuple[Known, ...] = ()
    forgotten: frozenset[tuple[str, str]] = field(default_factory=frozenset)


def stated_of(tags: Sequence[Tag], options: Sequence[str]) -> Stated:
    """What the table and the options say of ``tags``, which have names.

    TableError with all mistakes of the table, RecordError for one of the options and for what contradicts itself.
    """
    pvs, inputs = ([t for t in tags if t.role in roles] for roles in (("pv",), ("mv", "dv")))
    found, forgotten = list(_of_table(tags, pvs)), set[tuple[str, str]]()
    pairs = {
        f"{a}/{b}": (pv.name, given.name)
        for pv in pvs
        for given in inputs
        for a in (pv.tag, pv.name)
        for b in (given.tag, given.name)
    }
    for text in options:
        pair, sign, said = text.rpartition("=")
        if not sign:
            raise RecordError(f"--known {text}: write PV/INPUT={FORMS}")
        if pair.strip() not in pairs:
            raise RecordError(f"--known {text}: {pair!r} is no pair of a pv and an mv or dv{nearest(pair, pairs)}")
        names = pairs[pair.strip()]
        if not said.strip():
            forgotten.add(names)
            continue
        try:
            found.append(stated(*names, said))
        except ValueError as error:
            raise RecordError(f"--known {text}: {error}") from None
    try:
        return Stated(checked(together(found), tags), frozenset(forgotten))
    except ValueError as error:
        raise RecordError(f"known: {error}") from None


def signals_as_tags(of: Record | Simulator, tags: Sequence[Tag]) -> tuple[Tag, ...]:
    """A tag for each signal of a record or a simulator: that of ``tags`` by its name, where it has one."""
    groups = (("pv", of.pv_signals), ("mv", of.mv_signals), ("dv", of.dv_signals))
    own = {t.name: t for t in tags}
    return tuple(own.get(s.name, Tag(s.name, role, s.unit, name=s.name)) for role, signals in groups for s in signals)


def checked(known: tuple[Known, ...], tags: Sequence[Tag]) -> tuple[Known, ...]:
    """The statements; RecordError where they leave a controlled variable without an MV, or an MV without any."""
    pvs, mvs, dvs = ([t.name for t in tags if t.role == role] for role in ("pv", "mv", "dv"))
    if wrong := mistake_of_known(known, pvs, mvs, dvs, min(len(pvs), len(mvs))):
        raise RecordError(wrong)
    return known


def _of_table(tags: Sequence[Tag], pvs: Sequence[Tag]) -> Iterator[Known]:
    """The statements of column ``known``; an entry such as ``TIC-1.PV=`` says nothing."""
    wrong = []
    names = {word: pv.name for pv in pvs for word in (pv.tag, pv.name)}
    for tag in tags:
        for text in filter(None, (part.strip() for part in tag.known.split(";"))):
            pv, sign, said = text.rpartition("=")
            if sign and not said.strip():
                continue
            where = f"{tag.tag}, known: {text}"
            pv = pv.strip() if sign or len(pvs) > 1 else pvs[0].tag
            if tag.role not in {"mv", "dv"}:
                wrong.append(f"{where}: write it in the line of the mv or dv that the pv answers to")
            elif pv not in names:
                wrong.append(f"{where}: write PV={FORMS}; {pv!r} is no pv{nearest(pv, names)}")
            else:
                try:
                    yield stated(names[pv], tag.name, said)
                except ValueError as error:
                    wrong.append(f"{where}: {error}")
    if wrong:
        raise TableError(wrong)


def asked_of(known: Sequence[Known], record: Record, verdict: Verdict) -> list[str]:
    """Questions, one for each statement that one-step predictions of the record are certain to contradict.

    The answer is taken after the PV has settled, where the screening knows when that is; else its sign alone counts.
    """
    pvs, inputs = [s.name for s in record.pv_signals], [s.name for s in (*record.mv_signals, *record.dv_signals)]
    moves, found = np.hstack([record.mv, record.dv]), []
    for one in known:
        i, j = pvs.index(one.pv), inputs.index(one.input)
        settling_s = next((r.settling_s for r in verdict.inputs if r.name == one.input and one.pv in r.certain), 0.0)
        rows = int(np.clip(round(settling_s / record.period_s), FEWEST, MOST)) if settling_s else USUAL
        model = DirectModel.of(record.pv[:, i], moves, record.run, rows + rows // 2)
        said = one if settling_s or one.sign == NONE else _sign_of(one)
        if model is None or said is None:
            continue
        gain, sd = model.answer(j, rows, rows + rows // 2)
        least = NOTHING * float(record.pv[:, i].std() / max(moves[:, j].std(), 1e-300)) if one.sign == NONE else 0.0
        if said.excludes(gain, sd, least):
            found.append(one.question(gain, sd))
    return found


def _sign_of(one: Known) -> Known | None:
    """The statement without its gain and dead time; None where no sign is left."""
    return replace(one, sign="+" if one.way > 0 else "-", gain=None, dead_s=None) if one.way else None
