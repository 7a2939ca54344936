"""Made-up situations of a loop under a predictive law with ``operate``, each with the cause of its next move."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch

from loopwright.pipeline.laws.predictive.move_parts import ExplainedPredictive
from loopwright.pipeline.laws.predictive.predictive import Predictive
from loopwright.pipeline.models.identified.identified import Identified
from loopwright.pipeline.plants.simulator import Signals
from loopwright.serving import Signal
from loopwright.serving.explain import ExplainedMove, MovePart

HORIZON = 20  # samples
REST = 400  # samples of the model to come to rest
SETTLE = 60  # samples of the loop to come to rest
STILL = 1e-3  # largest move and error at rest
INSIDE = 0.3  # of an MV's range, at least, to either end: room for what happens
TOP = 3.0  # of the range of outputs


def made_model(seed: int, n_y: int, n_mv: int, n_hidden: int = 0, n_x: int = 5) -> Identified:
    """A stable model of random numbers with one measured disturbance; its scaled numbers are the engineering ones."""
    rng, n_v = np.random.default_rng(seed), n_mv + 1
    a = rng.normal(size=(n_x, n_x))
    a *= 0.85 / np.abs(np.linalg.eigvals(a)).max()
    buffers = {
        "a": a,
        "b": 0.3 * rng.normal(size=(n_x, n_v)),
        "c": 0.1 * rng.normal(size=n_x),
        "w1": 0.5 * rng.normal(size=(n_hidden, n_x + n_v)),
        "b1": 0.3 * rng.normal(size=n_hidden),
        "w2": 0.1 * rng.normal(size=(n_x, n_hidden)),
        "rest": np.eye(n_x, n_y + n_v + 1),
        "rest_cov": 0.01 * np.eye(n_x),
        "y_scale": np.ones(n_y),
        "v_scale": np.ones(n_v),
        "noise": np.full(n_y, 0.01),
    }
    model = Identified(n_y, n_mv, 1, n_x, n_hidden)
    for name, values in buffers.items():
        getattr(model, name).copy_(torch.from_numpy(np.asarray(values, dtype=np.float64)))
    return model.eval()


def law_over(model: Identified) -> Predictive:
    """The law with ``operate`` over signals that fit the model."""
    y = tuple(Signal(f"y{i}", "m", -TOP, TOP) for i in range(model.n_y))
    dv, mv = (
        tuple(Signal(f"{kind}{i}", "V", -1.0, 1.0) for i in range(n)) for kind, n in (("d", 1), ("u", model.n_mv))
    )
    return Predictive(Signals(1.0, y, y, dv, mv), model, Predictive.Params(horizon=HORIZON, operate={})).eval()


class MadeLoop:
    """A law over its own model, at rest; its attributes are what happens to it."""

    @torch.no_grad()
    def __init__(self, model: Identified, law: Predictive) -> None:
        self.model, self.law, self.explained = model, law, ExplainedPredictive(law).eval()
        zeros = [torch.zeros(n, dtype=torch.float64) for n in (model.n_x, 1, law.n_state, model.n_y, model.n_mv)]
        self.x, self.dv, self.state, self.load, self.bias = zeros
        self.mv = torch.tensor([0.1, -0.1, 0.05][: model.n_mv], dtype=torch.float64)
        other = self.x.clone()
        for _ in range(REST):
            self.x = model(torch.cat([self.x, self.mv, self.dv]))
            other = model(torch.cat([other, self.mv, self.dv + 0.1]))
        self.sign = float(torch.sign(model.measured(other)[0] - model.measured(self.x)[0]))  # of the disturbance on y0
        self.sp = self.pv.clone()
        self.operate = law.operate_default.clone()
        self.names = [entry.name for entry in law.operate]
        self.step(SETTLE)

    @property
    def pv(self) -> torch.Tensor:
        """Outputs (n_y,)."""
        return self.model.measured(self.x)

    def set(self, **values: float) -> None:
        """Entries of ``operate``, ``u0__high`` for ``u0.high``."""
        for name, value in values.items():
            self.operate[self.names.index(name.replace("__", "."))] = value

    def set_all(self, what: str, value: float) -> None:
        """One entry of every CV."""
        self.set(**{f"y{i}__{what}": value for i in range(self.model.n_y)})

    @property
    def rests(self) -> bool:
        """Whether the loop is at rest on its set points, with every MV within its range."""
        move = max(abs(m.move) for m in self.moves())
        off = float((self.pv - self.sp).abs().max())
        return move < STILL and off < STILL and float(self.mv.abs().max()) < 1 - INSIDE

    def inputs(self) -> tuple[torch.Tensor, ...]:
        """Those of the law."""
        fresh = torch.ones(self.model.n_y, dtype=torch.float64)
        return self.sp, self.pv, self.dv, self.mv, self.state, self.operate, fresh

    @torch.no_grad()
    def step(self, n: int = 1) -> None:
        """``n`` samples; a ``bias`` acts beside the MVs, a ``load`` at the outputs."""
        for _ in range(n):
            self.mv, self.state, _ = self.law(*self.inputs())
            self.x = self.model(torch.cat([self.x, self.mv + self.bias, self.dv]))
            self.x[: self.model.n_y] += self.load

    @torch.no_grad()
    def moves(self) -> list[ExplainedMove]:
        """The next moves."""
        found, n_mv = self.explained(*self.inputs()), self.model.n_mv
        rows = []
        for i, (move, parts) in enumerate(zip(found.move, found.parts.reshape(n_mv, -1), strict=True)):
            each = [MovePart(c, n, v) for (c, n), v in zip(self.explained.parts, parts.tolist(), strict=True)]
            each = sorted((p for p in each if abs(p.value) > 1e-13), key=lambda p: -abs(p.value))
            idle = float(self.operate[self.names.index(f"u{i}.use")]) == 0
            rest = MovePart("not_in_use", f"u{i}", 0.0) if idle else MovePart("plan", "", 0.0)
            rows.append(ExplainedMove(f"u{i}", "V", float(move), tuple(each) or (rest,), ""))
        return rows


@dataclass(frozen=True)
class Situation:
    """Words for it, what happens, the causes that are right, and the MV that is asked; None: that which moves most."""

    words: str
    happens: Callable[[MadeLoop], None]
    causes: frozenset[tuple[str, str]]
    mv: str | None

    def right(self, loop: MadeLoop) -> tuple[bool, ExplainedMove]:
        """Whether the first cause of the move is right; and the move. The loop must be at rest."""
        self.happens(loop)
        moves = loop.moves()
        asked = next((m for m in moves if m.mv == self.mv), None) or max(moves, key=lambda m: abs(m.move))
        return (asked.first.cause, asked.first.signal) in self.causes, asked


def _of(words: str, happens: Callable[[MadeLoop], None], *causes: tuple[str, str], mv: str | None = None) -> Situation:
    return Situation(words, happens, frozenset(causes), mv)


def _set_point(by: float) -> Callable[[MadeLoop], None]:
    def happens(loop: MadeLoop) -> None:
        loop.sp[0] += by

    return happens


def _disturbance(by: float) -> Callable[[MadeLoop], None]:
    def happens(loop: MadeLoop) -> None:
        loop.dv[0] += by

    return happens


def _load(loop: MadeLoop) -> None:
    loop.load[0] = 0.1
    loop.step()


def _bias(loop: MadeLoop) -> None:
    loop.bias[0] = 0.2
    loop.step()


def _free_above(loop: MadeLoop) -> None:
    loop.set(y0__track=0)
    loop.step(30)
    loop.set(y0__high=float(loop.pv[0]) - 0.1)


def _free_below(loop: MadeLoop) -> None:
    loop.set(y0__track=0)
    loop.step(30)
    loop.set(y0__low=float(loop.pv[0]) + 0.1)


def _near_an_end(loop: MadeLoop) -> None:
    loop.set(y0__track=0)
    loop.step(30)
    end = "high" if loop.sign > 0 else "low"
    loop.set(**{f"y0__{end}": float(loop.pv[0]) + loop.sign * 0.05})
    loop.step(40)
    loop.dv[0] += 0.4


def _cost_of_mv(loop: MadeLoop) -> None:
    loop.set_all("track", 0)
    loop.step(20)
    loop.set(u0__cost=1)


def _cost_of_cv(loop: MadeLoop) -> None:
    loop.set_all("track", 0)
    loop.step(20)
    loop.set(y0__cost=1)


def _rest(loop: MadeLoop) -> None:
    loop.set_all("track", 0)
    loop.step(20)
    loop.set(u1__rest=float(loop.mv[1]) + 0.4, u1__rest_use=1)


def _narrowed_high(loop: MadeLoop) -> None:
    loop.set(u0__high=float(loop.mv[0]) - 0.15)


def _narrowed_low(loop: MadeLoop) -> None:
    loop.set(u0__low=float(loop.mv[0]) + 0.15)


def _out(loop: MadeLoop) -> None:
    loop.set(u0__use=0)
    loop.sp[0] += 0.2


def _out_of_reach(loop: MadeLoop) -> None:
    for i, at in enumerate(loop.mv.tolist()):
        loop.set(**{f"u{i}__low": at - 0.1, f"u{i}__high": at + 0.1})
    loop.sp[0] += 1.0
    loop.step(60)


def _slow(loop: MadeLoop) -> None:
    loop.set(u0__max_move=0.02)
    loop.sp[0] += 0.3


def _narrowed_range(loop: MadeLoop) -> None:
    loop.set(y0__high=float(loop.pv[0]) - 0.1)


def _tracked_again(loop: MadeLoop) -> None:
    loop.set(y0__track=0)
    loop.step(20)
    loop.sp[0] += 0.2
    loop.step(20)
    loop.set(y0__track=1)


@torch.no_grad()
def _by_hand(loop: MadeLoop) -> None:
    loop.mv[0] += 0.2
    loop.x = loop.model(torch.cat([loop.x, loop.mv, loop.dv]))


Y = range(3)
SITUATIONS = (
    _of("the set point of y0 rises", _set_point(0.15), ("setpoint", "y0")),
    _of("the set point of y0 falls", _set_point(-0.15), ("setpoint", "y0")),
    _of("d0 rises", _disturbance(0.3), ("disturbance", "d0")),
    _of("d0 falls", _disturbance(-0.3), ("disturbance", "d0")),
    _of("a load at y0", _load, ("load", "y0")),
    _of("a load beside u0", _bias, *(("load", f"y{i}") for i in Y)),
    _of("y0 is above a new range", _free_above, ("range_high", "y0")),
    _of("y0 is below a new range", _free_below, ("range_low", "y0")),
    _of("y0 is near an end, and d0 brings it over", _near_an_end, ("disturbance", "d0")),
    _of("u0 costs", _cost_of_mv, ("cost", "u0"), mv="u0"),
    _of("y0 costs", _cost_of_cv, ("cost", "y0")),
    _of("u1 has a resting value", _rest, ("rest", "u1"), mv="u1"),
    _of("the high limit of u0 comes below it", _narrowed_high, ("mv_high", "u0"), mv="u0"),
    _of("the low limit of u0 comes above it", _narrowed_low, ("mv_low", "u0"), mv="u0"),
    _of("a limit of u0, and what u1 does then", _narrowed_high, ("mv_high", "u0"), mv="u1"),
    _of("u0 is out, and a set point rises", _out, ("not_in_use", "u0"), mv="u0"),
    _of("u0 is out, and what u1 does then", _out, ("setpoint", "y0"), mv="u1"),
    _of("a set point out of reach", _out_of_reach, ("mv_high", "u0"), ("mv_low", "u0"), mv="u0"),
    _of("u0 is slow, and a set point rises", _slow, ("setpoint", "y0"), mv="u0"),
    _of("a range of y0 leaves its set point out", _narrowed_range, ("range_high", "y0")),
    _of("y0 follows its set point again", _tracked_again, ("setpoint", "y0")),
    _of("u0 was moved by hand", _by_hand, *(("setpoint", f"y{i}") for i in Y), mv="u0"),
)
