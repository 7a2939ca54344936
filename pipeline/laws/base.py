"""The base of the control laws: a torch module with explicit state, exported as one graph."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Collection, Mapping
from dataclasses import dataclass, field
from typing import Any, ClassVar, Self, TypeAlias, TypeVar

import torch
from torch import Tensor, nn

from loopwright.pipeline.errors import LawError
from loopwright.pipeline.laws.actuator import Rates, rates_of
from loopwright.pipeline.models.base import Model
from loopwright.pipeline.plants.simulator import Array, Signals, Simulator

M = TypeVar("M", bound=Model)
Stepped: TypeAlias = tuple[Tensor, Tensor, Tensor]
"""Result of a step: the MV (..., n_mv), the next state (..., n_state), and info (..., n_info)."""


@dataclass(frozen=True, slots=True)
class Analysis:
    """Results of a law that need no closed-loop test, such as a proof of stability or a training history.

    ``figures`` go to the report, the manifest and the registry. ``arrays`` are for pictures.
    ``notes`` are sentences below the figures in the report. ``table`` has a row for each trial of a search, figures by
    column.
    """

    figures: Mapping[str, float] = field(default_factory=dict)
    arrays: Mapping[str, Array] = field(default_factory=dict)
    notes: tuple[str, ...] = ()
    table: tuple[Mapping[str, float], ...] = ()


def hold_numbers(module: nn.Module, **numbers: Any) -> None:
    """Register float64 buffers in this order, each in the shape of its values; a single number has shape (1,)."""
    for name, values in numbers.items():
        buffer = torch.tensor(values, dtype=torch.float64)
        module.register_buffer(name, buffer if buffer.ndim else buffer.reshape(1))


def require_part(models: Mapping[str, Model], part: str, law: str, n_in: int, n_out: int) -> Model:
    """The model named ``part`` of a model set, checked for its numbers of inputs and outputs.

    Raises a LawError that names the law's need and the parts of the set.
    """
    needs = f"law {law!r} needs a part {part!r} ({n_in} inputs, {n_out} outputs)"
    model = _named(models, part, needs)
    try:
        shape = tuple(model(torch.zeros(n_in, dtype=torch.float64)).shape)
    except (RuntimeError, ValueError, IndexError) as error:
        raise LawError(f"{needs}; the model set's takes other inputs: {error}".replace("\n", " ")) from error
    if shape != (n_out,):
        raise LawError(f"{needs}; the model set's gives {shape}")
    return model


def require_kind(models: Mapping[str, Model], cls: type[M], law: str, also: str = ", one MV, delay 1") -> M:
    """The model whose part name is its kind; ``also`` ends the words for what it must be.

    Raises a LawError that names the law's need and the parts of the set.
    """
    part = cls.kind
    needs = f"law {law!r} needs a part {part!r} (kind {part}{also})"
    model = _named(models, part, needs)
    if not isinstance(model, cls):
        raise LawError(f"{needs}; the model set's is of kind {model.kind}")
    return model


def _named(models: Mapping[str, Model], part: str, needs: str) -> Model:
    if part not in models:
        raise LawError(f"{needs}; the model set has {', '.join(sorted(models)) or 'no parts'}: add it to `parts:`")
    return models[part]


def require_single_loop(signals: Signals, law: str) -> None:
    """Raise LawError unless there is one set point and one MV."""
    if len(signals.sp) != 1 or len(signals.mv) != 1:
        raise LawError(
            f"law {law!r} controls one variable by one; got {len(signals.sp)} set points and {len(signals.mv)} MVs"
        )


class ControlLaw(nn.Module, ABC):
    """One step of a controller: ``(sp, pv, dv, mv_applied, state) -> (mv, state_next, info)``.

    Shapes ``(..., n_sp)``, ``(..., n_pv)``, ``(..., n_dv)``, ``(..., n_mv)``, ``(..., n_state)``;
    engineering units; float64. A state of zeros means "no history": the law handles its own first
    step. ``mv_applied`` is the MV that the plant received over the last period. A law that needs
    its last MV uses this value, which gives anti-windup and bumpless transfer. The law limits its
    MV to the signal's range and to ``rate`` per sample: its own ``mv_rate``, or the signal's ``max_move`` where
    that is less.
    """

    name: ClassVar[str]
    title: ClassVar[str]
    Params: ClassVar[type[Any]]  # frozen dataclass: the law's parameters in params.yaml, with `mv_rate`
    # True if the law adds a move to the applied MV: its transfer from manual is bumpless, and a start at the set
    # point does not move the actuator. Other laws compute the MV without the applied one.
    velocity_form: ClassVar[bool] = False
    # True if the law starts from an estimate of the plant's state, which the applied MV is a part of.
    estimates: ClassVar[bool] = False
    one_loop: ClassVar[bool] = True  # whether it controls one variable by one
    # Samples after a move within which the plant must have answered, the right way; None: any dead time suits.
    looks_ahead: ClassVar[int | None] = None
    # Samples after a move within which some PV must have answered, to tell of disturbances; None: any plant suits.
    observes_within: ClassVar[int | None] = None
    parts: ClassVar[Mapping[str, str]] = {}  # what `design` needs of the model set: part name -> what it must be
    n_state: int
    info: tuple[str, ...]
    low: Tensor  # (n_mv,)
    high: Tensor  # (n_mv,)
    rate: Tensor | None  # (n_mv,) largest change a sample, infinite without a limit; None where no MV has one

    def __init__(self, signals: Signals, mv_rate: Rates = None) -> None:
        super().__init__()
        self.signals = signals
        self.register_buffer("low", torch.tensor([s.low for s in signals.mv], dtype=torch.float64))
        self.register_buffer("high", torch.tensor([s.high for s in signals.mv], dtype=torch.float64))
        rates = rates_of(signals, mv_rate)
        self.register_buffer("rate", None if rates is None else torch.tensor(rates, dtype=torch.float64))

    @classmethod
    @abstractmethod
    def design(cls, params: Any, models: Mapping[str, Model], signals: Signals, plant: Simulator | None) -> Self:
        """The law with numbers from ``params`` and models by part name; raises LawError.

        ``plant`` is for laws that are tuned in simulation; a law from data alone ignores it. PlantError: the
        law needs a simulator or its equations, and there are none.
        """

    @abstractmethod
    def forward(self, sp: Tensor, pv: Tensor, dv: Tensor, mv_applied: Tensor, state: Tensor) -> Stepped:
        """One step."""

    @classmethod
    def needs(cls, params: Any, given: Collection[str] = ()) -> tuple[str, ...]:
        """Names of the parts that ``design`` needs with these parameters, of a set with the parts ``given``."""
        return tuple(cls.parts)

    @classmethod
    def check_settings(cls, params: Any, signals: Signals) -> None:
        """Raise LawError for parameters that do not fit the plant's signals; no model is needed."""
        rates_of(signals, getattr(params, "mv_rate", None))

    @classmethod
    def check(cls, params: Any, models: Mapping[str, Model], plant: Simulator) -> None:
        """Raise LawError if ``design`` would refuse the plant. No training is run; ``models`` may lack parts."""

    def analysis(self, plant: Simulator | None) -> Analysis:
        """The law's results without closed-loop tests on ``plant``; empty by default."""
        return Analysis()

    def calmed(self) -> Self | None:
        """The law with calmer numbers, for a plant on which its own do not hold; None: it has none."""
        return None

    def limited(self, mv: Tensor, mv_applied: Tensor) -> Tensor:
        """The MV limited to ``rate`` around the applied MV, if a rate is set, and then to the range.

        The range comes last, so an applied MV outside it (set by an operator) returns to it at once.
        """
        if self.rate is not None:
            mv = torch.minimum(torch.maximum(mv, mv_applied - self.rate), mv_applied + self.rate)
        return torch.minimum(torch.maximum(mv, self.low), self.high)
