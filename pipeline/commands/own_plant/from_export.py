"""``loopwright new NAME FILE...``: what the command line or the table of tags said, as params.yaml holds it."""

from __future__ import annotations

import argparse
import shlex
from collections.abc import Sequence
from functools import cache
from pathlib import Path

from loopwright.pipeline.commands.own_plant.knowledge import Widening
from loopwright.pipeline.commands.own_plant.number_options import limited, numbers_given
from loopwright.pipeline.config.exports import ExportParams, TimeSpan
from loopwright.pipeline.errors import RecordError
from loopwright.pipeline.historian.cleaning.findings import counted
from loopwright.pipeline.historian.cleaning.tags import (
    EXPLAINED,
    PV_ROLES,
    ROLES,
    Tag,
    as_it_is,
    check_tags,
    parse_tag,
    read_tags,
    write_tags,
)
from loopwright.pipeline.historian.export_params import exported
from loopwright.pipeline.historian.files.file_reader import read_export, tags_in, units_of
from loopwright.pipeline.historian.guessing import guesses, loops_in
from loopwright.serving.words import plain


def given_tags(options: argparse.Namespace) -> tuple[tuple[Tag, ...], str]:
    """The tags that a person gave, and where they stand."""
    known = cache(lambda: tags_in(options.files))
    given = tuple(parse_tag(text, role, known) for role in ROLES for text in getattr(options, role.replace("-", "_")))
    if given and options.tags:
        raise RecordError("--tags and options of roles are both given; give one of them")
    # A range in an option was stated; one in a table may be as it was guessed.
    widen = Widening(options) if options.tags else as_it_is
    found, where = (read_tags(options.tags, widen), str(options.tags)) if options.tags else (given, "the options")
    if found or options.tags:
        check_tags(found, where)
    found = limited(found, numbers_given(options), widen) if found else found
    for note in widen.notes if isinstance(widen, Widening) else ():
        print(note)
    return found, where


def asked(options: argparse.Namespace, tags: Sequence[Tag]) -> ExportParams:
    """``exports.<name>``: all that was said of the files."""
    for text in options.leave_out:
        try:
            TimeSpan.of(text)
        except ValueError as error:
            raise RecordError(f"--leave-out {error}") from None
    return ExportParams(
        case=options.name,
        files=tuple(options.files),
        tags=tuple(map(exported, tags)),
        period_s=options.period,
        hold_s=options.hold,
        without_mode=tuple(options.without_mode),
        leave_out=tuple(options.leave_out),
        time=options.time,
        time_format=options.time_format,
        time_zone=options.time_zone,
        anyway=options.anyway,
    )


def loop_lines(tags: Sequence[Tag]) -> list[str]:
    """The tags that belong together, a line a loop, for a person to correct."""
    return [
        f"loop {loop}: {', '.join(f'{role} {tag}' for role in ROLES for tag in roles.get(role, ()))}"
        for loop, roles in loops_in(tags).items()
    ]


def propose_tags(name: str, options: argparse.Namespace) -> None:
    """Write the table of all tags with guessed roles, for a person to correct, and say so."""
    path = Path(f"{name}-tags.csv")
    export = read_export(options.files, (), (), options.time, options.time_format, options.time_zone)
    first = not path.exists()
    rows = guesses(export, units_of(options.files))
    write_tags(path, rows)
    for note in export.notes:
        print(plain(f"  {note.column}: {note.words}"))
    roles = {r: [g.tag.tag for g in rows if g.tag.role == r] for r in ROLES}
    print(f"{path}: {counted(len(rows), 'tag')} with guessed roles; nothing else was written")
    for role, tags in roles.items():
        if tags or role not in PV_ROLES or role == "pv":  # no guess makes a constraint or an analyser
            print(plain(f"  {role:5} {', '.join(tags) or '-'}"))
    for line in loop_lines([g.tag for g in rows]):
        print(plain(f"  {line}"))
    files = " ".join(map(str, options.files))
    how = (("--time", options.time), ("--time-format", options.time_format), ("--time-zone", options.time_zone))
    given = "".join(f" {option} {shlex.quote(value)}" for option, value in how if value)
    given += " --replace" * options.replace
    if first:
        print(EXPLAINED)
    print(f"correct the table, then:\n  loopwright new {name} {files} --tags {path}{given}")
