"""The base of the control laws: a torch module with explicit state, the actuator as it sees it, and scaled defaults."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Collection, Mapping
from dataclasses import dataclass, field, fields, replace
from math import inf, isinf
from typing import Any, ClassVar, Self, TypeAlias, TypeVar

import torch
from torch import Tensor, nn

from loopwright.pipeline.errors import LawError
from loopwright.pipeline.models.base import Model
from loopwright.pipeline.plants.simulator import Array, Signals, Simulator
from loopwright.serving.manifest import OperateEntry
from loopwright.serving.preview.ahead import AheadInput

M = TypeVar("M", bound=Model)
Stepped: TypeAlias = tuple[Tensor, Tensor, Tensor]
"""Result of a step: the MV (..., n_mv), the next state (..., n_state), and info (..., n_info)."""


@dataclass(frozen=True, slots=True)
class Analysis:
    """Results of a law that need no closed-loop test, such as a proof of stability or a training history.

    ``figures`` go to the report, the manifest and the registry. ``arrays`` are for pictures.
    ``notes`` are sentences below the figures in the report. ``table`` has a row for each trial of a search, figures by
    column. The report draws its ``error`` [any unit] over its ``travel`` [% of the MVs' range a sample]; ``taken`` is 1
    in the row of the law's own numbers, and 0 in the others.
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
    operate: tuple[OperateEntry, ...] = ()  # of a law with two more inputs: what operators change, and fresh readings
    ahead: AheadInput | None = None  # of a law with one more input: set points and measured disturbances to come
    low: Tensor  # (n_mv,)
    high: Tensor  # (n_mv,)
    rate: Tensor | None  # (n_mv,) largest change a sample, twice the range without a limit; None where no MV has one

    def __init__(self, signals: Signals, mv_rate: Rates = None) -> None:
        super().__init__()
        self.signals = signals
        self.register_buffer("low", torch.tensor([s.low for s in signals.mv], dtype=torch.float64))
        self.register_buffer("high", torch.tensor([s.high for s in signals.mv], dtype=torch.float64))
        rates = rates_of(signals, mv_rate)
        # No MV moves farther than its range; an infinite rate could not be printed as C and Structured Text.
        widest = [2 * (s.high - s.low) for s in signals.mv]
        finite = None if rates is None else torch.tensor([*map(min, rates, widest)], dtype=torch.float64)
        self.register_buffer("rate", finite)

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


# ------------------------------------------------------------------------------------------- actuators as laws see them
Rates: TypeAlias = float | tuple[float | None, ...] | None
"""``mv_rate`` of a law [mv]: one number for all MVs, one for each with None for no limit, or None for none at all."""


def rates_of(signals: Signals, mv_rate: Rates) -> tuple[float, ...] | None:
    """The largest change of each MV a sample (n_mv,) [mv], infinite without a limit; None where no MV has one.

    An MV's limit is the lesser of ``max_move`` of its signal and of ``mv_rate``. LawError for another number of rates
    than of MVs, or for one that is not above 0.
    """
    names = ", ".join(s.name for s in signals.mv)
    given = mv_rate if isinstance(mv_rate, tuple) else (mv_rate,) * len(signals.mv)
    if len(given) != len(signals.mv):
        raise LawError(
            f"mv_rate has {len(given)} entries; give one number for all MVs, or one for each ({names}), null for no "
            "limit"
        )
    if any(rate is not None and not rate > 0 for rate in given):
        shown = list(mv_rate) if isinstance(mv_rate, tuple) else mv_rate
        raise LawError(f"mv_rate is {shown}; give the largest MV change a sample, above 0, or leave it out")
    both = [(inf if r is None else r, s.max_move or inf) for r, s in zip(given, signals.mv, strict=True)]
    # An on-off valve has no positions between, so no rate.
    rates = tuple(inf if s.values else min(pair) for s, pair in zip(signals.mv, both, strict=True))
    return None if all(map(isinf, rates)) and all(rate is None for rate in given) else rates


def stood_still(mv_applied: Tensor, applied_before: Tensor, given: Tensor, near: Tensor) -> Tensor:
    """Whether the actuator did not move although the law asked for a move, bool (..., 1).

    ``mv_applied`` and ``applied_before`` [mv] are what the plant received over the last period and over the one
    before it, ``given`` [mv] what the law asked for over the last period, each (..., 1). Differences up to ``near``
    [mv] count as none. An actuator that moves, but lags behind, does not stand still.
    """
    return ((mv_applied - given).abs() > near) & ((mv_applied - applied_before).abs() <= near)


def never_given(sp_move: Tensor, error_before: Tensor) -> Tensor:
    """The part of the last error that a move of the set point cancels, (..., 1), in the unit of the arguments.

        clip(-(r - r1), 0 and e1),   e1 = r1 - y1

    A set point that moves towards the process variable takes the proportional action of e1 out of the MV. An
    actuator that stood still has never received that action, and to take it out is a kick. The law adds this
    part to its set-point move in such a sample, and starts from the MV that the actuator holds. A move away from
    the process variable, or beyond it, keeps its proportional action.

    ``sp_move`` is r - r1, ``error_before`` e1, both (..., 1) and both with the same factor (a gain, a weight).
    """
    nothing = torch.zeros_like(error_before)
    low, high = torch.minimum(error_before, nothing), torch.maximum(error_before, nothing)
    return torch.minimum(torch.maximum(-sp_move, low), high)


# --------------------- defaults that follow from the range of the controlled variable, so that its unit does not matter
P = TypeVar("P")


class OfRange(float):
    """A default that counts in the set point's range: the parameter is ``share * range**power``.

    A parameter that somebody states is a plain float, in the unit that its docstring names. Until ``in_units``
    has turned it into that unit the default has the value of its share, above 0 as the parameter itself.
    """

    power: int

    def __new__(cls, share: float, power: int = 1) -> Self:
        """A share (-) of the range to a power."""
        made = super().__new__(cls, share)
        made.power = power
        return made

    def __getnewargs__(self) -> tuple[float, int]:  # type: ignore[override]  # float has one argument
        return float(self), self.power

    def __repr__(self) -> str:
        words = {1: "* range", -1: "/ range"}
        return f"{float(self):g} " + words.get(self.power, f"* range^{self.power}")

    __str__ = __repr__

    def over(self, span: float) -> float:
        """The parameter for a range of width ``span`` [pv]."""
        return float(self) * span**self.power


def ascend(low: float, high: float) -> bool:
    """Whether ``low < high``; True while only one of them is stated, as ``in_units`` has them compared again."""
    return isinstance(low, OfRange) != isinstance(high, OfRange) or low < high


def in_units(params: P, signals: Signals, law: str) -> P:
    """The parameters of a law with every default of the type ``OfRange`` in the unit of the controlled variable.

    Raises LawError where a stated parameter does not fit a default, such as a lower bound above the upper one.
    """
    span = signals.sp[0].high - signals.sp[0].low
    values = {field.name: getattr(params, field.name) for field in fields(params)}  # type: ignore[arg-type]
    scaled = {name: _over(value, span) for name, value in values.items()}
    changed = {name: value for name, value in scaled.items() if value is not values[name]}
    if not changed:
        return params
    try:
        return replace(params, **changed)  # type: ignore[type-var]
    except ValueError as error:
        raise LawError(f"law {law!r}: {error}") from error


def _over(value: Any, span: float) -> Any:
    if isinstance(value, OfRange):
        return value.over(span)
    if isinstance(value, tuple) and any(isinstance(v, OfRange) for v in value):
        return tuple(_over(v, span) for v in value)
    return value
