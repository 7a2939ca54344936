"""What every control law is: a torch module with explicit state, exported whole."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass, field
from math import inf
from typing import Any, ClassVar, Self, TypeVar

import torch
from torch import Tensor, nn

from pipeline.errors import LawError
from pipeline.models.base import Model
from pipeline.plants.signals import Signals
from pipeline.plants.simulator import Array, Simulator

M = TypeVar("M", bound=Model)


@dataclass(frozen=True, slots=True)
class Analysis:
    """What can be said of a law without a closed-loop test: a proof of stability, how a training went.

    ``figures`` go where people and programs read figures (report, manifest, registry); ``arrays`` are
    kept for pictures; ``notes`` are sentences that stand below the figures in the report.
    """

    figures: Mapping[str, float] = field(default_factory=dict)
    arrays: Mapping[str, Array] = field(default_factory=dict)
    notes: tuple[str, ...] = ()


def require_part(models: Mapping[str, Model], part: str, law: str, n_in: int, n_out: int) -> Model:
    """The model named ``part`` of a model set, checked for its numbers of inputs and outputs.

    Raises LawError that says what the law needs and what the set has.
    """
    needs = f"law {law!r} needs a part {part!r} ({n_in} inputs, {n_out} outputs)"
    if part not in models:
        raise LawError(f"{needs}; the model set has {', '.join(sorted(models)) or 'no parts'}: add it to `parts:`")
    model = models[part]
    try:
        shape = tuple(model(torch.zeros(n_in, dtype=torch.float64)).shape)
    except (RuntimeError, ValueError, IndexError) as error:
        raise LawError(f"{needs}; the model set's takes other inputs: {error}".replace("\n", " ")) from error
    if shape != (n_out,):
        raise LawError(f"{needs}; the model set's gives {shape}")
    return model


def require_kind(models: Mapping[str, Model], cls: type[M], law: str) -> M:
    """The model of a set that stands under its kind's own name, for laws that hold one loop by it.

    Raises LawError that says what the law needs and what the set has.
    """
    part = cls.kind
    needs = f"law {law!r} needs a part {part!r} (kind {part}, one MV, delay 1)"
    if part not in models:
        raise LawError(f"{needs}; the model set has {', '.join(sorted(models)) or 'no parts'}: add it to `parts:`")
    model = models[part]
    if not isinstance(model, cls):
        raise LawError(f"{needs}; the model set's is of kind {model.kind}")
    return model


def require_single_loop(signals: Signals, law: str) -> None:
    """Raise LawError unless there is one set point and one MV."""
    if len(signals.sp) != 1 or len(signals.mv) != 1:
        raise LawError(
            f"law {law!r} controls one variable by one; got {len(signals.sp)} set points and {len(signals.mv)} MVs"
        )


class ControlLaw(nn.Module, ABC):
    """One step of a controller: ``(sp, pv, dv, mv_applied, state) -> (mv, state_next, info)``.

    Shapes ``(..., n_sp)``, ``(..., n_pv)``, ``(..., n_dv)``, ``(..., n_mv)``, ``(..., n_state)``;
    engineering units; float64. A state of zeros means "no past": the law handles its own first
    step. ``mv_applied`` is what the plant received over the last period; a law that remembers its
    MV remembers this one, which is the anti-windup and the bumpless transfer. The law limits its
    own MV to the signal's range and to ``rate`` per sample.
    """

    name: ClassVar[str]
    title: ClassVar[str]
    Params: ClassVar[type[Any]]  # frozen dataclass: what params.yaml may say of this law; `mv_rate` among it
    # Does the law add a move to the applied MV? Such a law takes over from manual without a bump and, started on
    # set point, keeps the actuator where it is; the others compute the MV afresh, whatever was applied.
    incremental: ClassVar[bool] = False
    n_state: int
    info: tuple[str, ...]
    low: Tensor  # (n_mv,)
    high: Tensor  # (n_mv,)
    rate: Tensor | None  # (n_mv,) largest change a sample; None where unlimited

    def __init__(self, signals: Signals, mv_rate: float | None = None) -> None:
        super().__init__()
        self.signals = signals
        self.register_buffer("low", torch.tensor([s.low for s in signals.mv], dtype=torch.float64))
        self.register_buffer("high", torch.tensor([s.high for s in signals.mv], dtype=torch.float64))
        if mv_rate is not None and not mv_rate > 0:
            raise LawError(f"mv_rate is {mv_rate}; give the largest MV change a sample, above 0, or leave it out")
        # A valve that is open or shut has no rate: half way is nowhere.
        rates = [inf if s.values else mv_rate for s in signals.mv]
        self.register_buffer("rate", None if mv_rate is None else torch.tensor(rates, dtype=torch.float64))

    @classmethod
    @abstractmethod
    def design(cls, params: Any, models: Mapping[str, Model], signals: Signals, plant: Simulator | None) -> Self:
        """The law with numbers from ``params`` and models by part name; raises LawError.

        ``plant`` is for laws that are tuned in simulation; a law from data alone ignores it. A law that needs
        a simulator, or its equations, and has none raises PlantError.
        """

    @abstractmethod
    def forward(
        self, sp: Tensor, pv: Tensor, dv: Tensor, mv_applied: Tensor, state: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:
        """One step."""

    @classmethod
    def check(cls, params: Any, models: Mapping[str, Model], plant: Simulator) -> None:
        """Raise LawError where ``design`` would refuse the plant; without training, so ``models`` may lack parts."""

    def analysis(self, plant: Simulator | None) -> Analysis:
        """What the law says of itself beside its closed loops over ``plant``; nothing, unless it has a theory."""
        return Analysis()

    def limited(self, mv: Tensor, mv_applied: Tensor) -> Tensor:
        """The MV within the actuator's range and, where a rate is set, within reach of the applied one.

        The range comes last: an applied MV outside it (an operator's doing) is led back at once.
        """
        if self.rate is not None:
            mv = torch.minimum(torch.maximum(mv, mv_applied - self.rate), mv_applied + self.rate)
        return torch.minimum(torch.maximum(mv, self.low), self.high)
