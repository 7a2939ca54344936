"""A person's simulator file, whatever its language: the part of a plant that differs by language."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

from loopwright.pipeline.errors import PlantError
from loopwright.pipeline.plants.simulator import Array
from loopwright.serving.manifest import Signal


@dataclass(frozen=True, slots=True)
class Interface:
    """The signals of a program, controlled PVs first, its period [s], and the noise of PVs [their unit], by name.

    ``strides``: a step of many periods is as much work as a step of one.
    """

    period_s: float
    pv: tuple[Signal, ...]
    mv: tuple[Signal, ...]
    dv: tuple[Signal, ...] = ()
    noise: Mapping[str, float] | None = None
    strides: bool = False


class Program(Protocol):
    """A simulator that remembers nothing beside the state (n_x,) that it is given, whatever the state means.

    Each method raises PlantError for what the program does by mistake.
    """

    path: Path
    interface: Interface

    def start(self) -> tuple[Array, Array, Array]:
        """(state (n_x,), MVs (n_mv,), measured disturbances (n_dv,)) where an experiment starts."""

    def step(self, x: Array, mv: Array, dv: Array, periods: int) -> Array:
        """The state (n_x,) a number of periods later, under mv (n_mv,) and dv (n_dv,) held over them."""

    def measure(self, x: Array) -> Array:
        """The process variables (n_pv,) of a state (n_x,)."""

    def compared(self, x: Array) -> Array:
        """The part of a state that is the same whenever the same step is done again."""

    def wrong(self, words: str) -> PlantError:
        """An error that names the file, what is wrong in it, and where to look."""
