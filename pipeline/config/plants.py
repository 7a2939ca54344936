"""``plants.<name>`` of params.yaml: plants that are known by a record alone; `loopwright new` adds them."""

from __future__ import annotations

import dataclasses
import re
from pathlib import Path
from typing import Any

from pipeline.config.params import PARAMS_FILE, parse, read_section, sections
from pipeline.errors import ParamsError

SECTION = "plants"
NAME = re.compile(r"^[a-z][a-z0-9_]{0,63}$")


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
    """``plants.<name>``: period, signals, the clean record, the raw files behind it, and a simulator if it has one.

    ``controlled`` is the number of PVs that have a set point, the first ones of ``pv``. None: all of them, and where
    there are more PVs than MVs, as many as there are MVs. The controllers are tested on ``simulator``, the file of the
    plant's own simulator; None: on models of the record.
    """

    period_s: float
    pv: tuple[SignalParams, ...]  # controlled variables first
    mv: tuple[SignalParams, ...]
    dv: tuple[SignalParams, ...]
    data: Path
    source: tuple[RawFileParams, ...]
    simulator: Path | None = None
    controlled: int | None = None

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
