"""The ranges and moves that a controller may command, beside what a record or a simulator shows of its MVs."""

from __future__ import annotations

import argparse
import shlex
from collections.abc import Collection, Sequence
from dataclasses import dataclass, field, replace

from loopwright.pipeline.config.plants import mistakes_of_mv
from loopwright.pipeline.errors import RecordError
from loopwright.pipeline.historian.cleaning.findings import InputReport
from loopwright.pipeline.historian.cleaning.tags import Tag, commanded_range
from loopwright.pipeline.historian.files.file_reader import read_export
from loopwright.pipeline.historian.guessing import seen_range
from loopwright.pipeline.plants.simulator import Simulator
from loopwright.serving.manifest import Signal


def mvs_of(plant: Simulator) -> tuple[Tag, ...]:
    """The MVs of a simulator that states its signals itself."""
    return tuple(Tag(s.name, "mv", s.unit, s.low, s.high, s.name) for s in plant.mv_signals)


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
