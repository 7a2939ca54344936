"""An MV's range that was only guessed from its readings, widened where a person states commands beyond it."""

from __future__ import annotations

import argparse
from dataclasses import dataclass, field, replace

from loopwright.pipeline.historian.cleaning.tags import Tag
from loopwright.pipeline.historian.files.file_reader import read_export
from loopwright.pipeline.historian.guessing import seen_range


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
