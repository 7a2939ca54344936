"""Tags: which column is which signal, as options (`TIC-101.PV[degC]=0..200`) and as a table for a person to correct."""

from __future__ import annotations

import csv
import io
import re
import unicodedata
from collections.abc import Callable, Collection, Iterable, Sequence
from dataclasses import dataclass, replace
from enum import Enum
from math import inf
from pathlib import Path
from typing import Literal

from loopwright.pipeline.config.operator_defaults import OPERATED, mistakes_of_operated
from loopwright.pipeline.config.plants import mistakes_of_mv
from loopwright.pipeline.errors import RecordError, nearest
from loopwright.pipeline.files import write_text
from loopwright.pipeline.historian.cleaning.findings import InputReport
from loopwright.serving.fields import shown
from loopwright.serving.manifest import MAX_NAME, Signal

ROLES = ("pv", "constraint", "analyser", "constraint-analyser", "mv", "dv", "sp", "mode")
PV_ROLES = {
    "pv": (False, False),
    "constraint": (True, False),
    "analyser": (False, True),
    "constraint-analyser": (True, True),
}
"""Roles of process variables: whether one is kept in its range alone, and whether its readings are seldom and late."""
SIGNAL_ROLES = ("pv", "mv", "dv")
COMMANDS = ("command_low", "command_high", "max_move_per_min")  # of an MV, for the controller
WORDS = {"between": ("step", "line"), "ends": ("keep", "drop")}  # of columns that say how readings are taken
GUESSED_PAD = 0.25  # of the usual span, beyond it, in the range that the table guesses
KEEP = "write keep into column ends of the table of tags, which `loopwright new` without roles writes for --tags"
CERTAIN = {"": False, "no": False, "yes": True}
NUMBERS = ("low", "high", *COMMANDS, *OPERATED)
READ_ONLY = ("step", "good_percent", "remark")
COLUMNS = ("tag", "role", "name", "unit", "unit_certain", *NUMBERS, *WORDS, "loop", "known", *READ_ONLY)
NO_LOOP = "-"  # in column loop, of a tag whose name says another
OPTION = re.compile(r"^(?P<tag>.+?)(\[(?P<unit>[^\[\]]*)\])?(=(?P<low>[^.=]*(\.\d+)?)\.\.(?P<high>.+))?$")
AUTOMATIC = re.compile(r"a|aut.*|[abcr]?cas.*|kas.*", re.IGNORECASE)  # words of modes: a controller moves the MV
MANUAL = re.compile(r"m|i?man.*|h|hand.*", re.IGNORECASE)  # a person does, whatever else the mode's name says
DENIED = re.compile(r"not?|non|off|dis.*", re.IGNORECASE)  # words that take back what another says
BETWEEN_WORDS = re.compile(r"[\W\d_]+")  # of a mode's name, as in 2-AUTO and Local.Man
UNSAFE = re.compile(r"[^A-Za-z0-9_.\-/:#]+")
RANGES = """low, high: the range in which a reading can be true; of an mv it holds all that the valve did
command_low, command_high of an mv: the range that the controller may command; empty is low, high
max_move_per_min of an mv: the largest change that the controller may make in a minute, in the mv's unit; empty is
  no limit"""
EXPLAINED = f"""role: pv (to be controlled), constraint (a process variable that is only kept in its range), analyser
  (a pv with a new reading now and then), constraint-analyser (both), mv (what the controller commands), dv (measured
  disturbance), sp (set point of a loop), mode (of a loop); empty leaves a tag out
name: of the signal in reports and in the controller
unit_certain: yes where no reading can be in another unit; empty lets the screening look for such readings
{RANGES}
range_low, range_high of a pv, constraint or analyser: the range that the controller keeps it in; empty of a constraint
  is what the record had
rank of these: 1 to 4, which range is kept first where two are at odds; empty is 3
rest of an mv: where it goes while nothing else asks for it
cost per unit of a pv or mv: what costs or, below 0, earns money; only ratios count
between: line or step, how a tag that is stored by exception or compressed goes from one reading to the next; empty
  guesses
ends: keep or drop rows at the lowest or highest value, a limit of the plant or the end of the transmitter; empty
  drops them unless low and high, given by you, go beyond; keep of an mv says that no rest of it is a stop of the plant
loop: tags with the same word belong together, a pv with its sp, mode and mv; - is none; empty goes by the tag's name
known, of an mv or dv: what you know of each pv's answer, as in TIC-1.PV=+, gain 0.5..2, dead 30..60; TIC-2.PV=none
step, good_percent, remark: the smallest difference of two readings, the share of good ones, what was seen; only to
  read. docs/tag_table.md says more"""


class TableError(RecordError):
    """A corrected table has mistakes; ``mistakes`` are all of them, a line each."""

    def __init__(self, mistakes: Sequence[str]) -> None:
        super().__init__("; ".join(mistakes))
        self.mistakes = tuple(mistakes)


@dataclass(frozen=True, slots=True)
class Tag:
    """A column of the export and what it is in the plant; the range is None where the data give it.

    ``command_low``, ``command_high`` and ``max_move_per_min`` as in MvParams.
    """

    tag: str
    role: str  # pv, mv, dv, sp, mode; "" is not used. A constraint and an analyser are PVs, too
    unit: str = ""
    low: float | None = None
    high: float | None = None
    name: str = ""  # of the signal; "" is the tag's own, made safe
    command_low: float | None = None
    command_high: float | None = None
    max_move_per_min: float | None = None
    unit_certain: bool = False  # no reading is in another unit
    between: Literal["", "step", "line"] = ""  # how it goes from one reading to the next; "" is guessed
    ends: Literal["", "keep", "drop"] = ""  # rows at its lowest or highest value; "" as its range says
    loop: str = ""  # tags of one word are one loop; "" goes by the tag's name, NO_LOOP is none
    known: str = ""  # of an input: PV=STATEMENT; PV=STATEMENT, as a person wrote it
    constraint: bool = False  # a PV without a set point, which is kept in its range
    analyser: bool = False  # a PV with a new reading now and then
    range_low: float | None = None  # of a PV: the range that the controller keeps it in
    range_high: float | None = None
    rank: float | None = None  # of that range, 1 is kept first
    rest: float | None = None  # of an MV: where it goes while nothing else asks for it
    cost: float | None = None  # of a PV or an MV, per unit

    @property
    def stated_role(self) -> str:
        """The role as the table of tags has it."""
        if self.role != "pv":
            return self.role
        return next(word for word, of in PV_ROLES.items() if of == (self.constraint, self.analyser))

    @property
    def operated(self) -> dict[str, float]:
        """The numbers of OPERATED that were given, by their names."""
        given = {name: getattr(self, name) for name in OPERATED}
        return {name: value for name, value in given.items() if value is not None}

    @property
    def commands(self) -> dict[str, float]:
        """The controller's limits that were given, by their names in params.yaml."""
        given = {name: getattr(self, name) for name in COMMANDS}
        return {name: value for name, value in given.items() if value is not None}

    def signal(self, low: float, high: float) -> Signal:
        """The signal of the tag; ``low`` and ``high`` count where the tag has none."""
        low, high = (low if self.low is None else self.low), (high if self.high is None else self.high)
        return Signal(self.name or safe_name(self.tag), self.unit, low, high)


class Look(Enum):
    """The look of a tag's readings."""

    TEXTS = "texts instead of numbers"
    NOTHING = "no good reading"
    CONSTANT = "constant"
    LABEL = "a label, a counter or a switch"  # none is a signal
    STEPS = "moves in steps"
    MOVES = ""


@dataclass(frozen=True, slots=True)
class Guess:
    """One line of the table: the tag as guessed, and what its readings look like."""

    tag: Tag
    step: float  # smallest difference of two values; 0 where it has none
    good: float  # share of good readings
    look: Look = Look.MOVES
    notes: tuple[str, ...] = ()

    @property
    def remark(self) -> str:
        """Findings and guesses, for a person."""
        return "; ".join(filter(None, (self.look.value, *self.notes)))

    def as_role(self, role: str, note: str = "") -> Guess:
        """The guess with another role, and a note on why."""
        return replace(self, tag=replace(self.tag, role=role), notes=(*self.notes, *filter(None, [note])))


def by_hand(mode: str) -> bool:
    """Whether the name of a mode says that a person moves the MV."""
    return _says(mode, MANUAL)


def automatic(mode: str) -> bool:
    """Whether the name of a mode says that a controller moves the MV."""
    return not by_hand(mode) and _says(mode, AUTOMATIC)


def _says(mode: str, kind: re.Pattern[str]) -> bool:
    """Whether a mode's name has a word of a kind, and none that takes it back."""
    words = BETWEEN_WORDS.split(mode)
    return any(map(kind.fullmatch, words)) and not any(map(DENIED.fullmatch, words))


def of_role(tag: Tag) -> Tag:
    """The tag whose role is a word of the table: a constraint or an analyser becomes a PV that is one."""
    if tag.role not in PV_ROLES:
        return tag
    constraint, analyser = PV_ROLES[tag.role]
    return replace(tag, role="pv", constraint=constraint, analyser=analyser)


def safe_name(tag: str) -> str:
    """A name that a manifest, a column `NAME [unit]` and a picture can hold: Latin letters, digits, and _ . - / : #."""
    plain = unicodedata.normalize("NFKD", tag.replace("ß", "ss").replace("µ", "u"))
    plain = "".join(c for c in plain if not unicodedata.combining(c))
    name = UNSAFE.sub("-", plain).strip("-")[:MAX_NAME]
    return name or "signal"


def named(tags: Sequence[Tag]) -> tuple[Tag, ...]:
    """The tags with safe names, no two of them the same."""
    taken: set[str] = set()
    found = []
    for tag in tags:
        base = safe_name(tag.name or tag.tag)
        name, i = base, 2
        while name in taken:
            name, i = f"{base}-{i}", i + 1
        taken.add(name)
        found.append(replace(tag, name=name))
    return tuple(found)


def parse_tag(text: str, role: str, known: Callable[[], Collection[str]] = frozenset) -> Tag:
    """A tag of an option: ``TAG``, ``TAG[unit]``, ``TAG[unit]=LOW..HIGH``; RecordError for another form.

    Where the last bracket may belong to the tag, as of ``TIC[1]``, the tags ``known`` from the files decide.
    """
    match = OPTION.match(text.strip())
    if match is None or match["tag"].count("[") < match["tag"].count("]"):
        raise RecordError(
            f"--{role} {text}: write TAG, TAG[unit] or TAG[unit]=LOW..HIGH, as in TIC-101.PV[degC]=0..200"
        )
    low, high = (finite_number(match[key], f"--{role} {text}") if match[key] else None for key in ("low", "high"))
    name, unit = match["tag"].strip(), (match["unit"] or "").strip()
    if "=" in text and (whole := text.strip()) in known():  # FI=3..4
        name, unit, low, high = whole, "", None, None
    elif match["unit"] is not None:
        whole = text.strip()[: match.end("unit") + 1]
        tags = known()
        if whole in tags or (name not in tags and unit.isdecimal()):
            name, unit = (whole, "") if name not in tags or unit.isdecimal() else (name, unit)
    tag = of_role(Tag(name, role, unit, low, high))
    if wrong := mistakes_of_tag(tag):
        raise RecordError(f"--{role} {text}: {'; '.join(wrong)}")
    return tag


Widen = Callable[[Tag], Tag]
"""Gives a tag the range that it may have, before its numbers are checked."""


def as_it_is(tag: Tag) -> Tag:
    """The tag: no range is widened."""
    return tag


def commanded_range(signal: Signal | InputReport, tags: Sequence[Tag]) -> tuple[float, float]:
    """The range that the controller may command a signal over: as the tag of its name says, else its own."""
    commands = next((t.commands for t in tags if t.name == signal.name), {})
    return commands.get("command_low", signal.low), commands.get("command_high", signal.high)


def check_tags(tags: Sequence[Tag], where: str) -> None:
    """RecordError unless there are a PV and an MV, and every tag has one role."""
    for role, words in (("pv", "process variable"), ("mv", "manipulated variable")):
        if not any(t.role == role and not t.constraint for t in tags):
            raise RecordError(f"{where}: no {words} is named; give at least one --{role} TAG, or role {role} in --tags")
    names = [t.tag for t in tags]
    twice = [n for n in names if names.count(n) > 1]
    if twice:
        raise RecordError(f"{where}: {twice[0]!r} is named twice; each tag has one role")


def write_tags(path: Path, guesses: Iterable[Guess]) -> None:
    """The table of all tags, for a person to correct; RecordError where the file is there already."""
    if path.exists():
        raise RecordError(f"{path} is there already; correct it and give --tags {path}, or remove it for a new one")
    out, guesses = io.StringIO(), list(guesses)
    rows = csv.writer(out, lineterminator="\n")
    rows.writerow(COLUMNS)
    pairs = "; ".join(f"{g.tag.tag}=" for g in guesses if g.tag.role == "pv")  # for a person to go on with
    for g in guesses:
        t = g.tag
        good = f"{100 * g.good:.2f}"
        numbers = ["" if v is None else f"{v:.6g}" for v in (getattr(t, name) for name in NUMBERS)]
        rows.writerow(
            [
                t.tag,
                t.stated_role,
                safe_name(t.tag),
                t.unit,
                "yes" if t.unit_certain else "",
                *numbers,
                *("" for _ in WORDS),
                t.loop,
                pairs if t.role in {"mv", "dv"} else "",
                f"{g.step:.6g}" if g.step else "",
                good,
                g.remark,
            ]
        )
    write_text(path, out.getvalue())


def read_tags(path: Path, widen: Widen = as_it_is) -> tuple[Tag, ...]:
    """The tags that have a role in a corrected table; RecordError names line and column of every mistake.

    A spreadsheet's semicolons and decimal commas are read too.
    """
    try:
        text = path.read_text(encoding="utf-8-sig")
    except FileNotFoundError:
        raise RecordError(f"{path}: no such file; `loopwright new NAME FILE` without roles writes one") from None
    except UnicodeDecodeError:
        text = path.read_text(encoding="cp1252")
    separator = max(",;\t", key=text.partition("\n")[0].count)
    try:
        rows = list(csv.reader(io.StringIO(text), delimiter=separator))
    except csv.Error as error:
        raise RecordError(f"{path} is no table: {error}") from None
    header = [h.strip().lower() for h in rows[0]] if rows else []
    for column in ("tag", "role"):
        if column not in header:
            raise RecordError(f"{path}: column {column!r} is missing; the table has {', '.join(COLUMNS)}")
    found, wrong = list[Tag](), list[str]()
    for line, row in enumerate(rows[1:], start=2):
        cells = dict(zip(header, (c.strip() for c in row), strict=False))
        role = cells.get("role", "").lower()
        if not cells.get("tag") or role in {"", "-", "ignore", "none"}:
            continue
        where = f"{path}, line {line} ({cells['tag']})"
        if role not in ROLES:
            wrong.append(f"{where}: role {shown(role)}{nearest(role, ROLES)}; leave it empty for a tag without one")
            continue
        numbers: dict[str, float] = {}
        for key in NUMBERS:
            try:
                numbers |= {key: finite_number(cells[key], f"{where}, {key}")} if cells.get(key) else {}
            except RecordError as error:
                wrong.append(str(error))
        certain = cells.get("unit_certain", "").lower()
        if certain not in CERTAIN:
            wrong.append(f"{where}, unit_certain: {shown(certain)} is neither yes nor no; empty is no")
        taken = {key: cells.get(key, "").lower() for key in WORDS}
        wrong += [
            f"{where}, {key}: {shown(word)} is neither {' nor '.join(WORDS[key])}; empty leaves it to the screening"
            for key, word in taken.items()
            if word not in ("", *WORDS[key])
        ]
        unit, name = cells.get("unit", ""), cells.get("name", "")
        given = of_role(Tag(cells["tag"], role, unit, name=name, **numbers))  # type: ignore[arg-type]
        given = replace(given, loop=cells.get("loop", ""), known=cells.get("known", ""))
        tag = widen(replace(given, unit_certain=CERTAIN.get(certain, False), **taken))  # type: ignore[arg-type]
        wrong += [f"{where}: {words}" for words in mistakes_of_tag(tag)]
        found.append(tag)
    if wrong:
        raise TableError(wrong)
    return tuple(found)


def mistakes_of_tag(tag: Tag) -> list[str]:
    """Faults in the numbers of a tag, a clause each."""
    if tag.role != "mv" and tag.commands:
        verb, it = ("belong", "them") if len(tag.commands) > 1 else ("belongs", "it")
        return [f"{', '.join(tag.commands)} {verb} to an mv, which the controller commands; leave {it} empty"]
    low, high = (-inf if tag.low is None else tag.low), (inf if tag.high is None else tag.high)
    if tag.role == "mv":
        low, high = tag.commands.get("command_low", low), tag.commands.get("command_high", high)
    return [*mistakes_of_mv(tag), *mistakes_of_operated(tag.role, tag.stated_role, tag.operated, (low, high))]


def finite_number(text: str, where: str) -> float:
    """The number of a cell or an option; RecordError, beginning with ``where``, for another text."""
    try:
        value = float(text.strip().replace(",", "."))
    except ValueError:
        value = float("nan")
    if not abs(value) < float("inf"):
        raise RecordError(f"{where}: {shown(text)} is no finite number")
    return value
