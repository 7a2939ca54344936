"""``exports.<plant>`` of params.yaml screened: `loopwright new` and stage `screen` make a record in the same way."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from loopwright.pipeline.config.exports import ExportedTag, ExportParams
from loopwright.pipeline.historian.guessing import controlled_first, loop_of
from loopwright.pipeline.historian.reading import read_export, units_of
from loopwright.pipeline.historian.screening import Screened, screened
from loopwright.pipeline.historian.tags import Tag, named, safe_name


def exported(tag: Tag) -> ExportedTag:
    """The entry of a tag that a person gave; what the controller may command stands with the plant."""
    name = "" if tag.name == safe_name(tag.tag) else tag.name
    # What column loop says as the name does needs no word.
    said = (tag.unit_certain, tag.between, tag.ends, "" if tag.loop == loop_of(tag.tag) else tag.loop)
    return ExportedTag(tag.tag, tag.role, tag.unit, tag.low, tag.high, name, *said)  # type: ignore[arg-type]


def signal_tags(tags: Sequence[ExportedTag]) -> tuple[Tag, ...]:
    """The tags with the names and in the order of the plant's signals; units as given."""
    given = [
        Tag(
            *(t.tag, t.role, t.unit, t.low, t.high, t.name),
            unit_certain=t.unit_certain,
            between=t.between,
            ends=t.ends,
            loop=t.loop,
        )
        for t in tags
    ]
    return controlled_first(named(given))


def with_units(tags: Sequence[Tag], params: ExportParams) -> tuple[Tag, ...]:
    """The tags, those without a unit with the unit that the files state."""
    units = units_of(params.files)
    return tuple(t if t.unit or t.role == "mode" else replace(t, unit=units.get(t.tag, "")) for t in tags)


def screened_export(params: ExportParams, tags: Sequence[Tag]) -> Screened:
    """The files read and screened; ``tags`` have names and units. RecordError as ``read_export`` and ``screened``."""
    values, modes = ([t.tag for t in tags if (t.role == "mode") is mode] for mode in (False, True))
    export = read_export(params.files, values, modes, params.time, params.time_format, params.time_zone)
    return screened(
        params.case, export, tags, params.period_s, params.hold_s, params.without_mode, leave_out=params.leave_out
    )
