"""``plants.<name>`` of params.yaml: plants that are known by a record alone; `loopwright new` adds them."""

from __future__ import annotations

import dataclasses
import math
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Protocol

from loopwright.pipeline.config.exports import is_exported, screened_record
from loopwright.pipeline.config.known import NONE, Known, together
from loopwright.pipeline.config.params import PARAMS_FILE, parse, read_section, sections
from loopwright.pipeline.errors import ParamsError, nearest

SECTION = "plants"
NAME = re.compile(r"^[a-z][a-z0-9_]{0,63}$")


@dataclasses.dataclass(frozen=True, slots=True)
class SignalParams:
    """One signal: its name, unit, and the range in which it is meaningful.

    ``every``: rows from one new reading of an analyser to the next; 1: it is read in each row.
    """

    name: str
    unit: str
    low: float
    high: float
    every: int = 1

    def __post_init__(self) -> None:
        if not self.low < self.high:
            raise ValueError(f"{self.name} has the range {self.low:g} to {self.high:g}; low must be below high")
        if self.every < 1:
            raise ValueError(f"{self.name}: every is {self.every}; give the rows between two readings, 1 or more")


@dataclasses.dataclass(frozen=True, slots=True)
class MvParams:
    """An MV: its name, unit, and the range that its readings lie in; and what a controller may do with it.

    A controller commands it from ``command_low`` to ``command_high`` (None: ``low``, ``high``), and changes it by at
    most ``max_move_per_min`` in a minute [unit of the MV] (None: no limit).
    """

    name: str
    unit: str
    low: float
    high: float
    command_low: float | None = None
    command_high: float | None = None
    max_move_per_min: float | None = None

    def __post_init__(self) -> None:
        wrong = mistakes_of_mv(self)
        if wrong:
            raise ValueError(f"{self.name}: {'; '.join(wrong)}")

    @property
    def command(self) -> tuple[float, float]:
        """The range that a controller commands."""
        low, high = self.command_low, self.command_high
        return (self.low if low is None else low), (self.high if high is None else high)


class Commanded(Protocol):
    """Numbers of an MV, None where they are not given."""

    @property
    def low(self) -> float | None:
        """Lowest reading."""

    @property
    def high(self) -> float | None:
        """Highest reading."""

    @property
    def command_low(self) -> float | None:
        """Lowest command."""

    @property
    def command_high(self) -> float | None:
        """Highest command."""

    @property
    def max_move_per_min(self) -> float | None:
        """Largest change in a minute."""


def mistakes_of_mv(mv: Commanded) -> list[str]:
    """Faults in the numbers of an MV, a clause each."""
    wrong = []
    low, high = (-math.inf if mv.low is None else mv.low), (math.inf if mv.high is None else mv.high)
    if not low < high:
        wrong.append(f"the range is {low:g} to {high:g}; low must be below high")
    for name in ("command_low", "command_high"):
        value = getattr(mv, name)
        if value is not None and low < high and not low <= value <= high:
            wrong.append(f"{name} is {value:g}, outside low to high, {low:g} to {high:g}; choose one within")
    first = low if mv.command_low is None else mv.command_low
    last = high if mv.command_high is None else mv.command_high
    if not wrong and not first < last:
        wrong.append(f"the commands range from {first:g} to {last:g}; command_low must be below command_high")
    if mv.max_move_per_min is not None and not 0 < mv.max_move_per_min < math.inf:
        wrong.append(
            f"max_move_per_min is {mv.max_move_per_min:g}; give a change above 0 in a minute, or leave it empty"
        )
    return wrong


def mistake_of_known(
    known: Sequence[Known], pvs: Sequence[str], mvs: Sequence[str], dvs: Sequence[str], controlled: int
) -> str:
    """A mistake in the statements on pairs of a plant's signals, a sentence; empty where nothing is wrong.

    A controlled PV needs an MV that moves it, and an MV that moves none of them is no MV.
    """
    for one in known:
        for name, names, what in ((one.pv, pvs, "process variable"), (one.input, [*mvs, *dvs], "input")):
            if name not in names:
                return f"known: {one.says!r} is said of {one.pair}, and {name!r} is no {what}{nearest(name, names)}"
    try:
        joined = together(known)
    except ValueError as error:
        return f"known: {error}"
    still = {(one.pv, one.input) for one in joined if one.sign == NONE}
    for pv in pvs[:controlled]:
        if all((pv, mv) in still for mv in mvs):
            return f"known: no MV moves {pv}, so that none can hold it; take a `none` away, or give {pv} no role"
    for mv in mvs:
        if all((pv, mv) in still for pv in pvs[:controlled]):
            return f"known: {mv} moves no controlled variable; take a `none` away, or let {mv} be no mv"
    return ""


@dataclasses.dataclass(frozen=True, slots=True)
class RawFileParams:
    """A raw file that the record was made from."""

    file: str
    sha256: str


@dataclasses.dataclass(frozen=True, slots=True)
class PlantParams:
    """``plants.<name>``: period, signals, the clean record, and a simulator if it has one.

    ``data`` is left out where ``exports.<name>`` has the files of the record; else ``source`` has them.
    ``controlled`` is the number of PVs that have a set point, the first ones of ``pv``. None: all of them, and where
    there are more PVs than MVs, as many as there are MVs. The controllers are tested on ``simulator``, the file of the
    plant's own simulator; None: on models of the record. ``known`` is what an engineer knows of pairs of PV and input,
    a statement a pair.
    """

    period_s: float
    pv: tuple[SignalParams, ...]  # controlled variables first
    mv: tuple[MvParams, ...]
    dv: tuple[SignalParams, ...]
    data: Path
    source: tuple[RawFileParams, ...] = ()
    simulator: Path | None = None
    controlled: int | None = None
    known: tuple[Known, ...] = ()

    @property
    def n_controlled(self) -> int:
        """Number of PVs that have a set point."""
        return min(len(self.pv), len(self.mv)) if self.controlled is None else self.controlled

    def __post_init__(self) -> None:
        if not self.period_s > 0:
            raise ValueError(f"period_s is {self.period_s:g}; it must be positive")
        if not self.pv or not self.mv:
            raise ValueError("pv and mv need one signal or more each")
        most = min(len(self.pv), len(self.mv))
        if not 1 <= self.n_controlled <= most:
            raise ValueError(
                f"controlled is {self.controlled}; {len(self.pv)} PVs and {len(self.mv)} MVs allow 1 to {most}: "
                "each controlled variable needs an MV of its own"
            )
        signals: tuple[SignalParams | MvParams, ...] = (*self.pv, *self.mv, *self.dv)
        names = [s.name for s in signals]
        twice = [n for n in names if names.count(n) > 1]
        if twice:
            raise ValueError(f"signal {twice[0]!r} is there twice; give each its own name")
        for s in self.dv:
            if s.every != 1:
                raise ValueError(f"{s.name}: every is {s.every}; a measured disturbance is read in each row, give 1")
        if wrong := mistake_of_known(
            self.known,
            [s.name for s in self.pv],
            [s.name for s in self.mv],
            [s.name for s in self.dv],
            self.n_controlled,
        ):
            raise ValueError(wrong)

    @classmethod
    def read(cls, name: str, path: Path = PARAMS_FILE) -> PlantParams:
        """The section of one plant; ParamsError where it is not there or wrong."""
        entries = own_plants(path)
        if name not in entries:
            raise ParamsError(f"{path}: {SECTION} has no {name!r}; known: {', '.join(entries) or 'none'}")
        made = {"data": screened_record(name).as_posix()} if is_exported(name, path) else {}
        if made and "data" in entries[name]:
            raise ParamsError(
                f"{path}: {SECTION}.{name} has `data`, and exports.{name} has the files of its record; remove one"
            )
        return parse(cls, entries[name] | made, f"{SECTION}.{name}")


def own_plants(path: Path = PARAMS_FILE) -> dict[str, Any]:
    """Name -> section of every plant of this kind; none where params.yaml has no such section."""
    return {name: read_section(SECTION, name, path) for name in sections(SECTION, path)}


def check_name(name: str, path: Path = PARAMS_FILE, *, replace: bool = False) -> None:
    """ParamsError unless a plant can have this name: well-formed, and neither a plant nor a case has it.

    With ``replace`` an own plant may have it. A case that is no own plant is never replaced.
    """
    if not NAME.match(name):
        raise ParamsError(
            f"the name {name!r} cannot be a plant's: a small letter, then small letters, digits and _ (64 at most)"
        )
    if name in sections(SECTION, path):
        if not replace:
            raise ParamsError(f"{path}: {SECTION} has {name!r} already; choose another name, or give --replace")
    elif name in sections("cases", path):
        also = "; --replace replaces own plants alone" if replace else ""
        raise ParamsError(f"{path}: cases has {name!r} already; choose another name{also}")
