"""``plants.<name>`` of params.yaml: plants that are known by a record alone. `loopwright new` appends them."""

from __future__ import annotations

import dataclasses
import os
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import yaml

from pipeline.config.params import PARAMS_FILE, parse
from pipeline.errors import ParamsError
from pipeline.files import write_bytes

SECTION = "plants"
NAME = re.compile(r"^[a-z][a-z0-9_]{0,63}$")
COMMENT = "# Plants that are known by their records alone; each entry was written by `loopwright new`."


@dataclasses.dataclass(frozen=True, slots=True)
class SignalParams:
    """One signal: its name, unit, and the range in which it is meaningful."""

    name: str
    unit: str
    low: float
    high: float

    def __post_init__(self) -> None:
        if not self.low < self.high:
            raise ValueError(f"{self.name} has the range {self.low:g} to {self.high:g}; low must be below high")


@dataclasses.dataclass(frozen=True, slots=True)
class RawFileParams:
    """A raw file that the record was made from."""

    file: str
    sha256: str


@dataclasses.dataclass(frozen=True, slots=True)
class PlantParams:
    """``plants.<name>``: period, signals, the clean record, and the raw files behind it."""

    period_s: float
    pv: tuple[SignalParams, ...]  # controlled variables first
    mv: tuple[SignalParams, ...]
    dv: tuple[SignalParams, ...]
    data: Path
    source: tuple[RawFileParams, ...]

    def __post_init__(self) -> None:
        if not self.period_s > 0:
            raise ValueError(f"period_s is {self.period_s:g}; it must be positive")
        if not self.pv or not self.mv:
            raise ValueError("pv and mv need one signal or more each")
        names = [s.name for s in (*self.pv, *self.mv, *self.dv)]
        twice = [n for n in names if names.count(n) > 1]
        if twice:
            raise ValueError(f"signal {twice[0]!r} is there twice; give each its own name")

    @classmethod
    def read(cls, name: str, path: Path = PARAMS_FILE) -> PlantParams:
        """The section of one plant; ParamsError where it is not there or wrong."""
        entries = own_plants(path)
        if name not in entries:
            raise ParamsError(f"{path}: {SECTION} has no {name!r}; known: {', '.join(entries) or 'none'}")
        return parse(cls, entries[name], f"{SECTION}.{name}")


def own_plants(path: Path = PARAMS_FILE) -> dict[str, Any]:
    """Name -> section of every plant of this kind; none where params.yaml has no such section."""
    section = _tree(_text(path), path).get(SECTION) or {}
    if not isinstance(section, dict):
        raise ParamsError(f"{path}: {SECTION} is {section!r}; it must be a mapping of names to their sections")
    return {str(name): entry for name, entry in section.items()}


def check_name(name: str, path: Path = PARAMS_FILE) -> None:
    """ParamsError unless a plant can have this name: well-formed, and neither a plant nor a case has it."""
    if not NAME.match(name):
        raise ParamsError(
            f"the name {name!r} cannot be a plant's: a small letter, then small letters, digits and _ (64 at most)"
        )
    tree = _tree(_text(path), path)
    for kind in (SECTION, "cases"):
        if name in (tree.get(kind) or {}):
            raise ParamsError(f"{path}: {kind} has {name!r} already; choose another name, or remove that section")


def append_plant(name: str, entry: Mapping[str, Any], path: Path = PARAMS_FILE) -> None:
    """Add ``plants.<name>`` to params.yaml; every byte that was there stays, and a failure changes nothing.

    Raises ParamsError where the name is taken, or the section is not written as a block.
    """
    parse(PlantParams, entry, f"{SECTION}.{name}")
    check_name(name, path)
    before = _text(path)
    after = _with_entry(before, name, entry, path)
    expected = _tree(before, path)
    expected[SECTION] = {**(expected.get(SECTION) or {}), name: dict(entry)}
    if _tree(after, path) != expected:
        raise ParamsError(f"{path}: {SECTION}.{name} cannot be added; write the file's sections as plain YAML blocks")
    mode = path.stat().st_mode & 0o777
    write_bytes(path.resolve(), after.encode("utf-8"))
    os.chmod(path, mode)


def _with_entry(text: str, name: str, entry: Mapping[str, Any], path: Path) -> str:
    end = "\r\n" if "\r\n" in text else "\n"
    body = yaml.safe_dump({name: dict(entry)}, sort_keys=False, allow_unicode=True, width=10_000, indent=2)
    lines = [f"  {line}" for line in body.splitlines()]
    rows = text.splitlines(keepends=True)
    head = next((i for i, row in enumerate(rows) if re.match(rf"{SECTION}\s*:", row)), None)
    if head is None:
        last = "" if not text or text.endswith(("\n", "\r")) else end
        return text + last + end.join(["", COMMENT, f"{SECTION}:", *lines, ""])
    if re.match(rf"{SECTION}\s*:\s*[^\s#]", rows[head]):
        raise ParamsError(f"{path}: {SECTION} is not a block; write `{SECTION}:` on a line of its own")
    # The section ends with its last line that is indented; what follows belongs to the next one.
    place = head + 1
    for i in range(head + 1, len(rows)):
        if rows[i].strip() and not rows[i][0].isspace() and not rows[i].startswith("#"):
            break
        if rows[i][0].isspace() and rows[i].strip():
            place = i + 1
    before = "".join(rows[:place])
    return before + ("" if before.endswith(("\n", "\r")) else end) + end.join([*lines, ""]) + "".join(rows[place:])


def _text(path: Path) -> str:
    try:
        return path.read_bytes().decode("utf-8")
    except FileNotFoundError:
        raise ParamsError(f"{path} is not here; run from the repository's root") from None
    except UnicodeDecodeError as error:
        raise ParamsError(f"{path} is not UTF-8: {error}") from None


def _tree(text: str, path: Path) -> dict[str, Any]:
    try:
        tree = yaml.load(text, Loader=getattr(yaml, "CSafeLoader", yaml.SafeLoader))
    except yaml.YAMLError as error:
        raise ParamsError(f"{path} is not YAML: {' '.join(str(error).split())}") from None
    if not isinstance(tree, dict):
        raise ParamsError(f"{path} holds no mapping; it needs the sections cases, records, models, controllers")
    return tree
