"""Knowledge of a plant given to ``loopwright new``: what a controller may command, and pairs of PV and input."""

from __future__ import annotations

import argparse
import shlex
from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass, field, replace

from loopwright.pipeline.config.known import FORMS, Known, stated, together
from loopwright.pipeline.config.plants import mistake_of_known, mistakes_of_mv
from loopwright.pipeline.errors import RecordError, nearest
from loopwright.pipeline.historian.cleaning.findings import InputReport
from loopwright.pipeline.historian.cleaning.tags import TableError, Tag, commanded_range
from loopwright.pipeline.historian.files.file_reader import read_export
from loopwright.pipeline.historian.guessing import seen_range
from loopwright.pipeline.plants.simulator import Simulator
from loopwright.pipeline.records.record import Record
from loopwright.serving.manifest import Signal


def signals_of_simulator(plant: Simulator) -> tuple[Tag, ...]:
    """The process variables and MVs of a simulator that states its signals itself."""
    groups = (("pv", plant.pv_signals), ("mv", plant.mv_signals))
    return tuple(Tag(s.name, role, s.unit, s.low, s.high, s.name) for role, signals in groups for s in signals)


def check_commands(signals: Sequence[Signal], tags: Sequence[Tag]) -> None:
    """RecordError where an MV's range of commands leaves its own range, which a simulator may have stated itself."""
    for s in signals:
        tag = next((t for t in tags if t.name == s.name), None)
        if tag is not None and (wrong := mistakes_of_mv(replace(tag, low=s.low, high=s.high))):
            low, high = commanded_range(s, tags)
            raise RecordError(
                f"{s.name} may be commanded from {low:g} to {high:g} {s.unit}, outside its range: {'; '.join(wrong)}"
            )


def commanded(inputs: Sequence[InputReport], tags: Sequence[Tag]) -> list[InputReport]:
    """The inputs, the MVs with the ranges that may be commanded: a step test stays within them."""
    ends = [commanded_range(i, tags) for i in inputs]
    return [replace(i, low=low, high=high) for i, (low, high) in zip(inputs, ends, strict=True)]


def confirmed(signals: Sequence[Signal], tags: Sequence[Tag], operated: Collection[str] = ()) -> list[str]:
    """The ranges and moves that the controller may command, a line for each MV of which a person said it.

    And one for each of the ``operated`` MVs of which nobody did: the output of its old controller may have had limits,
    for a reason that no record shows.
    """
    lines = []
    for s in signals:
        tag = next((t for t in tags if t.name == s.name), None)
        limits = {} if tag is None else tag.commands
        if tag is not None and not {"command_low", "command_high"} & set(limits) and s.name in operated:
            lines.append(
                f"{s.name}: the controller may command all of {s.low:g} to {s.high:g} {s.unit}, from end to end "
                f"in one period; where the old controller's output is limited, or no valve may slam, say so: --command "
                f"{shlex.quote(f'{tag.tag}=LOW..HIGH')}, --max-move {shlex.quote(f'{tag.tag}=CHANGE')} in a minute"
            )
        if limits:
            low, high = commanded_range(s, tags)
            fastest = limits.get("max_move_per_min")
            pace = "" if fastest is None else f", at most {fastest:g} {s.unit} in a minute"
            lines.append(f"{s.name}: the controller may command {low:g} to {high:g} {s.unit}{pace}")
    return lines


def check_start(plant: Simulator, tags: Sequence[Tag]) -> None:
    """RecordError where tests on a simulator would begin at an MV that may not be commanded."""
    for signal, value in zip(plant.mv_signals, plant.start[1], strict=True):
        low, high = commanded_range(signal, tags)
        if not low <= value <= high:
            raise RecordError(
                f"the simulator starts with {signal.name} = {value:g} {signal.unit}, and {low:g} to {high:g} may be "
                "commanded; widen that range, or let the simulator start within"
            )


# ---------------------------------------------------------------- a guessed range that a person states commands beyond
@dataclass(slots=True)
class Widening:
    """Widens the tags that it is called with, and keeps a note of each.

    A table of tags holds ``low`` and ``high`` of an MV as the readings showed them. An end that still stands there as
    it was guessed gives way to a command beyond it; an end that a person wrote does not.
    """

    options: argparse.Namespace
    notes: list[str] = field(default_factory=list)

    def __call__(self, tag: Tag) -> Tag:
        """The tag, with ends that hold what may be commanded where these were guessed."""
        low, high, first, last = tag.low, tag.high, tag.command_low, tag.command_high
        below = low is not None and first is not None and first < low
        above = high is not None and last is not None and last > high
        if tag.role != "mv" or not (below or above) or not self.options.files:
            return tag
        options = self.options
        export = read_export(options.files, (tag.tag,), (), options.time, options.time_format, options.time_zone)
        seen = seen_range(export.series[tag.tag])
        if seen is None:
            return tag
        found = replace(
            tag,
            low=first if below and _same(low, seen[0]) else low,
            high=last if above and _same(high, seen[1]) else high,
        )
        if found != tag:
            self.notes.append(
                f"{tag.tag}: its range was guessed from the readings, {seen[0]:.6g} to {seen[1]:.6g}; it is widened to "
                f"{found.low:.6g} to {found.high:.6g}, which the controller may command. Beyond the readings the "
                "models rest on no data"
            )
        return found


def _same(end: float | None, seen: float) -> bool:
    """Whether an end of the table is the guess, with the digits that a table has."""
    return end is not None and f"{end:.6g}" == f"{seen:.6g}"


@dataclass(frozen=True, slots=True)
class Stated:
    """The statements, one a pair; ``--known PV/INPUT=`` takes those on the ``forgotten`` pairs back, wherever made."""

    known: tuple[Known, ...] = ()
    forgotten: frozenset[tuple[str, str]] = field(default_factory=frozenset)


def stated_of(tags: Sequence[Tag], options: Sequence[str]) -> Stated:
    """The statements of the table and the options on ``tags``, which have names.

    TableError with all mistakes of the table, RecordError for one of the options and for what contradicts itself.
    """
    pvs, inputs = ([t for t in tags if t.role in roles] for roles in (("pv",), ("mv", "dv")))
    found, forgotten = list[Known](), set[tuple[str, str]]()
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
    # What an option takes back is taken back of the table too, which `new` may have written from an earlier option.
    found = [one for one in _of_table(tags, pvs) if (one.pv, one.input) not in forgotten] + found
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
    controlled = sum(t.role == "pv" and not t.constraint for t in tags)
    if wrong := mistake_of_known(known, pvs, mvs, dvs, min(controlled, len(mvs))):
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
