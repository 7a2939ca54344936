"""Options of ``loopwright new`` that give a tag numbers: commands of an MV, ranges, ranks, rests, costs."""

from __future__ import annotations

import argparse
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

from loopwright.pipeline.config.operator_defaults import OPERATED
from loopwright.pipeline.errors import RecordError, nearest
from loopwright.pipeline.historian.cleaning.tags import (
    COMMANDS,
    Tag,
    Widen,
    as_it_is,
    finite_number,
    mistakes_of_tag,
)


@dataclass(frozen=True, slots=True)
class NumbersOption:
    """An option ``--NAME TAG=NUMBERS``: the roles whose tags it may name, and the numbers of a tag that it gives."""

    roles: tuple[str, ...]
    keys: tuple[str, ...]
    form: str
    example: str
    help: str


NUMBER_OPTIONS = {
    "command": NumbersOption(
        ("mv",),
        COMMANDS[:2],
        "LOW..HIGH",
        "TIC-101.OP=15..85",
        "range that the controller may command an MV over, within the range of its readings",
    ),
    "max-move": NumbersOption(
        ("mv",),
        COMMANDS[2:],
        "CHANGE",
        "TIC-101.OP=5",
        "largest change of an MV in a minute that the controller may make, in the MV's unit",
    ),
    "range": NumbersOption(
        ("pv",),
        OPERATED[:2],
        "LOW..HIGH",
        "PI-7=2..8",
        "range that predictive control keeps a process variable in; operators may change it",
    ),
    "rank": NumbersOption(
        ("pv",), OPERATED[2:3], "NUMBER", "PI-7=1", "which range is kept first where two are at odds, 1 to 4 (3)"
    ),
    "rest": NumbersOption(
        ("mv",), OPERATED[3:4], "VALUE", "FIC-2.OP=40", "where an MV goes while nothing else asks for it"
    ),
    "cost": NumbersOption(
        ("pv", "mv"),
        OPERATED[4:],
        "NUMBER",
        "FIC-2.OP=1.5",
        "cost of a unit of an MV or a process variable, below 0 a gain; only ratios count",
    ),
}
"""Options that give numbers of a tag, by their names."""


def limited(tags: Sequence[Tag], given: Mapping[str, Iterable[str]], widen: Widen = as_it_is) -> tuple[Tag, ...]:
    """The tags with what options say of them: for each name of NUMBER_OPTIONS texts ``TAG=NUMBERS``.

    RecordError for another form, for a tag of another role, and for numbers that cannot be.
    """
    found = {t.tag: t for t in tags}
    for option, text in ((option, text) for option, texts in given.items() for text in texts):
        of, where = NUMBER_OPTIONS[option], f"--{option} {text}"
        name, _, value = text.rpartition("=")
        ends = value.split("..") if len(of.keys) > 1 else [value]
        if not name or len(ends) != len(of.keys):
            raise RecordError(f"{where}: write TAG={of.form}, as in {of.example}")
        names = [t.tag for t in tags if t.role in of.roles]
        if name not in names:
            raise RecordError(f"{where}: {name!r} is no {' or '.join(of.roles)}{nearest(name, names)}")
        numbers = {key: finite_number(end, where) for key, end in zip(of.keys, ends, strict=True)}
        found[name] = widen(replace(found[name], **numbers))  # type: ignore[arg-type]
        if wrong := mistakes_of_tag(found[name]):
            raise RecordError(f"{where}: {'; '.join(wrong)}")
    return tuple(found[t.tag] for t in tags)


def numbers_given(options: argparse.Namespace) -> dict[str, list[str]]:
    """The texts of each option of NUMBER_OPTIONS that a person gave."""
    return {name: getattr(options, name.replace("-", "_")) for name in NUMBER_OPTIONS}
