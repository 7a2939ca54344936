"""``loopwright new``: what a person knows of pairs of PV and input, by ``--known`` and by the table of tags."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field

from loopwright.pipeline.config.known import FORMS, Known, stated, together
from loopwright.pipeline.config.plants import mistake_of_known
from loopwright.pipeline.errors import RecordError, nearest
from loopwright.pipeline.historian.cleaning.tags import TableError, Tag
from loopwright.pipeline.plants.simulator import Simulator
from loopwright.pipeline.records.record import Record


@dataclass(frozen=True, slots=True)
class Stated:
    """The statements, one a pair; ``--known PV/INPUT=`` takes those on the ``forgotten`` pairs back."""

    known: tuple[Known, ...] = ()
    forgotten: frozenset[tuple[str, str]] = field(default_factory=frozenset)


def stated_of(tags: Sequence[Tag], options: Sequence[str]) -> Stated:
    """The statements of the table and the options on ``tags``, which have names.

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
