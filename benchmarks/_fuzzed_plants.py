"""Laws with ``operate`` and plants for them that fail in every way, and what is wrong with the commands they get."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Collection
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
import torch
from numpy.typing import NDArray

from loopwright.pipeline.export.gate import export
from loopwright.pipeline.export.plain_code.compiled_law import law_stepping
from loopwright.pipeline.laws.predictive.predictive import Predictive
from loopwright.pipeline.models.identified.identified import Identified
from loopwright.pipeline.plants.identified import StateEquation
from loopwright.pipeline.plants.simulator import Signals
from loopwright.serving import Controller, EndpointError, Guard, Mode, Sample, SampleError, Signal
from loopwright.serving.guard import READ_BACK_MARGIN
from loopwright.serving.operating import Operate
from loopwright.serving.vectorized_controller import ComputeRows

Array: TypeAlias = NDArray[np.float64]

TOP = 3.0  # of the ranges of made-up outputs
FASTEST = 0.05  # of an MV's range a period, where it has a rate
ROUNDING = 1e-9  # of an MV's range: less is no move
HORIZON = 15  # samples: longer ones cost time and show nothing else


@dataclass(frozen=True)
class Kind:
    """Sizes of a law and its plant."""

    name: str
    n_sp: int
    n_y: int
    n_mv: int
    units: int = 0
    rates: bool = False
    integrates: bool = False
    n_dv: int = 0


KINDS = (
    Kind("1x1 linear", 1, 1, 1),
    Kind("1x1 network, rate", 1, 1, 1, units=4, rates=True),
    Kind("1x1 integrator, rate", 1, 1, 1, rates=True, integrates=True),
    Kind("2x2 linear, rates", 2, 2, 2, rates=True, n_dv=1),
    Kind("2x2 network", 2, 2, 2, units=4),
    Kind("2x2 network with an integrator, rates", 2, 2, 2, units=4, rates=True, integrates=True),
    Kind("2x3 linear, rates", 2, 2, 3, rates=True),
    Kind("2x3 network", 2, 2, 3, units=4, n_dv=1),
    Kind("3x2 linear", 3, 3, 2),
    Kind("3x2 network, rates", 3, 3, 2, units=4, rates=True),
    Kind("2x2 and a range, rates", 2, 3, 2, rates=True),
)


# ------------------------------------------------------------------------------------------------- the laws and plants
def signals_of(kind: Kind, share: float = 1.0) -> Signals:
    """Outputs within +-3; MVs of odd ranges, of which the controller has a ``share``."""
    y = tuple(Signal(f"y{i}", "m", -TOP, TOP) for i in range(kind.n_y))
    dv = tuple(Signal(f"d{i}", "V", -1.0, 1.0) for i in range(kind.n_dv))
    mv = []
    for i in range(kind.n_mv):
        low, high = 7.3 * i - 20.0, 7.3 * i + 31.7
        middle, half = (low + high) / 2, share * (high - low) / 2
        most = FASTEST * (1 + i) * (high - low) if kind.rates else None
        mv.append(Signal(f"u{i}", "%", middle - half, middle + half, max_move=most))
    return Signals(1.0, y[: kind.n_sp], y, dv, tuple(mv))


def model_of(kind: Kind, seed: int) -> Identified:
    """A plant of random numbers whose outputs answer within a horizon; the last output may integrate."""
    rng, n_v = np.random.default_rng(seed), kind.n_mv + kind.n_dv
    n_x = kind.n_y + 2
    a = 0.1 * rng.normal(size=(n_x, n_x))
    a *= 0.2 / max(np.abs(np.linalg.eigvals(a)).max(), 0.2)
    a += np.diag(rng.uniform(0.6, 0.8, n_x))
    b = 0.3 * rng.normal(size=(n_x, n_v))
    if kind.integrates:
        last = kind.n_y - 1
        a[last], a[:, last] = 0.0, 0.0
        a[last, last], b[last] = 1.0, 0.1 + 0.1 * rng.random(n_v)
    mv = signals_of(kind).mv
    w1, w2 = 0.4 * rng.normal(size=(kind.units, n_x + n_v)), 0.1 * rng.normal(size=(n_x, kind.units))
    if kind.integrates:
        w2[kind.n_y - 1] = 0.0
    known = {
        "a": a, "b": b, "c": 0.05 * rng.normal(size=n_x), "w1": w1, "w2": w2,
        "y_scale": np.ones(kind.n_y), "noise": np.full(kind.n_y, 0.01),
        "v_center": np.array([s.middle for s in mv] + [0.0] * kind.n_dv),
        "v_scale": np.array([(s.high - s.low) / 2 for s in mv] + [1.0] * kind.n_dv),
        "rest": np.eye(n_x, kind.n_y + n_v + 1), "rest_cov": 0.01 * np.eye(n_x),
    }  # fmt: skip
    model = Identified(kind.n_y, kind.n_mv, kind.n_dv, n_x, kind.units)
    for name, values in known.items():
        getattr(model, name).copy_(torch.from_numpy(np.asarray(values, dtype=np.float64)))
    return model.eval()


def laws_of(number: int, folder: Path) -> list[Path]:
    """Files of a kind: the law, the same with narrower MVs and other numbers, and one without ``operate``."""
    kind, files = KINDS[number], []
    for k, (share, operate) in enumerate(((1.0, {}), (0.8, {"speed": 2.0}), (1.0, None))):
        file = folder / f"law{number}_{k}.onnx"
        if not file.exists():
            params = Predictive.Params(horizon=HORIZON, operate=operate, caution=1.0 + k)
            law = Predictive(signals_of(kind, share), model_of(kind, 100 * number), params).eval()
            export(law, file, case="fuzz", provenance={})
        files.append(file)
    return files


# ------------------------------------------------------------------------------------------------------ what is counted
class Findings:
    """Faults of a history, each once by name, and the counts of what happened in it."""

    def __init__(self) -> None:
        self.wrong, self.first = Counter[str](), dict[str, str]()
        self.seen, self.faults = Counter[str](), Counter[str]()
        self.scan = 0

    def add(self, name: str, words: str = "") -> None:
        """Something is wrong."""
        self.wrong[name] += 1
        self.first.setdefault(name, f"scan {self.scan}: {name} {words}")


class RowSession:
    """A session's place taken by the compiled plain C, on the buffers that the controller bound."""

    def __init__(self, compute: ComputeRows, given: Array, taken: Array) -> None:
        self.compute, self.given, self.taken = compute, given.reshape(1, -1), taken

    def run_with_iobinding(self, _binding: Any) -> None:
        """One step."""
        self.taken[:] = self.compute(self.given)[0]


class Watched(Controller):
    """A controller whose steps are looked at: what it was given, and what it gave; ``law_by`` as of ``stress``."""

    def __init__(self, path: Path, law_by: str = "onnx") -> None:
        super().__init__(path)
        compute = law_stepping(Controller(path), law_by).compute  # over the conformance kit as the session computes it
        if compute is not None:
            self._session = RowSession(compute, self._in, self._out)
        self.findings = Findings()
        m = self.manifest
        self.low, self.high = np.array([s.low for s in m.mv]), np.array([s.high for s in m.mv])
        self.span, self.most = self.high - self.low, np.array([s.most for s in m.mv])
        places = Operate(m.operate).places
        self.of = {
            what: [places[f"{s.name}.{what}"] for s in m.mv] for what in ("use", "low", "high", "max_move") if places
        }
        self._last, self._next = np.full(len(m.mv), np.nan), np.zeros(0)  # its last MV, and the state after it

    def step(self, **given: Any) -> Any:  # type: ignore[override]
        """As ``Controller.step``; an exception is counted as a refused step."""
        try:
            step = super().step(**given)
        except SampleError:  # without guards a law that does not read ``fresh`` is given any number
            self.findings.seen["refused readings"] += 1
            raise
        except Exception as error:
            self.findings.add("refused step", f"{type(error).__name__}: {error}")
            raise
        mv, state = np.array(step.mv), np.asarray(given["state"])
        applied = np.clip(np.asarray(given["mv_applied"], dtype=np.float64), self.low, self.high)
        if not (np.isfinite(mv).all() and np.isfinite(step.state).all() and np.isfinite(step.info).all()):
            self.findings.add("not finite", str(mv))
        if (mv < self.low).any() or (mv > self.high).any():
            self.findings.add("law out of range", str(mv))
        if (np.abs(mv - applied) > self.most).any():
            self.findings.add("law faster than its rate", f"{applied} to {mv}")
        if self.of:
            operate = given.get("operate")
            known = np.array(self.manifest.usual("operate")) if operate is None else np.asarray(operate)
            self._judged(known, mv, applied, warm=np.array_equal(state, self._next))
        self._last, self._next = mv, np.array(step.state)
        return step

    def _judged(self, operate: Array, mv: Array, applied: Array, *, warm: bool) -> None:
        """Operators' limits: an MV goes no faster than they let it, and leaves no range that it is in."""
        use, low, high, most = (operate[self.of[what]] for what in ("use", "low", "high", "max_move"))
        as_told = warm and np.array_equal(applied, self._last)
        slack = (ROUNDING if as_told else READ_BACK_MARGIN + ROUNDING) * self.span
        move = np.abs(mv - applied)
        if (move > np.where(use > 0, most, 0.0) + slack).any():
            name = "out of use moves" if (move[use == 0] > slack[use == 0]).any() else "faster than operators let it"
            self.findings.add(name, f"{applied} to {mv}, use {use}, max_move {most}")
        was, now = (np.maximum(np.maximum(low - at, at - high), 0.0) for at in (applied, mv))
        if ((use > 0) & (now > was + slack)).any():
            self.findings.add("leaves operators' limits", f"{applied} to {mv}, {low} to {high}")


@dataclass(frozen=True)
class WatchedGuard:
    """A guard whose own exceptions are counted."""

    guard: Guard
    findings: Findings

    @property
    def memory(self) -> int:
        """Of the guard."""
        return self.guard.memory

    def check(self, sample: Sample, past: Collection[Sample]) -> str | None:
        """As the guard's."""
        try:
            return self.guard.check(sample, past)
        except Exception as error:
            self.findings.add("exception in a guard", f"{type(error).__name__}: {error}")
            raise


# ---------------------------------------------------------------------------------------------------------- the plant
class MadePlant:
    """A plant that differs from its model, with broken sensors, actuators in local, and a network that fails."""

    def __init__(self, kind: Kind, seed: int, rng: np.random.Generator, findings: Findings) -> None:
        self.rng, self.findings, self.signals = rng, findings, signals_of(kind)
        self.model = StateEquation(
            *(getattr(model_of(kind, seed), n).numpy() for n in ("a", "b", "c", "w1", "b1", "w2"))
        )
        self.kind, self.gain = kind, rng.uniform(0.7, 1.3, kind.n_mv)
        mv = self.signals.mv
        self.low, self.high = np.array([s.low for s in mv]), np.array([s.high for s in mv])
        self.span, self.most = self.high - self.low, np.array([s.most for s in mv])
        self.x = np.zeros(len(self.model.c))
        self.at = self.low + self.span * rng.random(kind.n_mv)  # where the actuators stand
        self.offset = rng.uniform(-0.019, 0.019, kind.n_mv) * self.span * (rng.random() < 0.3)
        self.reads_back = rng.random() < 0.9
        self.local = np.zeros(kind.n_mv, dtype=bool)
        self.broken: list[tuple[str, int]] = [("", 0)] * kind.n_y  # of each PV: how, for how many scans more
        self.deaf = self.silent = 0  # scans for which writes, reads fail
        self.shown = np.zeros(kind.n_y)
        self.sample: Sample | None = None
        self.written: Array | None = None
        self.known: Array | None = None  # shape: (n_mv,), the last read-back of each that an actuator can have
        self.mode: Callable[[], Mode] = lambda: Mode.MANUAL  # of the loop, now
        self.held = False  # whether HOLD moves nothing
        self.theirs: Callable[[], NDArray[np.bool_]] = lambda: np.zeros(
            len(self.low), dtype=bool
        )  # MVs in hand, or local

    def read(self) -> Sample:
        """The present sample."""
        self._broken()
        rng, kind = self.rng, self.kind
        pv = self.x[: kind.n_y] + 0.01 * rng.normal(size=kind.n_y)
        bad, fresh = [""] * kind.n_y, np.ones(kind.n_y)
        for i, (how, left) in enumerate(self.broken):
            if how == "nan":
                pv[i] = rng.choice([np.nan, np.inf, -np.inf])
            elif how == "frozen":
                pv[i] = self.shown[i]
            elif how == "jumped":
                pv[i] += 2.0
            elif how == "huge":
                pv[i] = rng.choice([-1, 1]) * 10.0 ** rng.integers(1, 300)
            elif how == "bad":
                bad[i] = "its quality is bad"
                pv[i] = rng.choice([np.nan, 0.0, 1e300])
            elif how == "stale":
                fresh[i] = 0.0
                pv[i] = rng.choice([np.nan, self.shown[i], 1e9])
            self.broken[i] = (how if left > 1 else "", max(left - 1, 0))
        self.shown = np.where(np.isfinite(pv), pv, self.shown)
        dv = rng.uniform(-1, 1, kind.n_dv)
        if self.silent or rng.random() < 0.005:
            self.silent = max(self.silent - 1, 0)
            self.sample = None
            raise EndpointError("no answer")
        applied = self.at + self.offset
        before = applied.copy() if self.known is None else self.known
        told = np.ones(kind.n_mv, dtype=bool)
        if rng.random() < 0.01:
            i = rng.integers(kind.n_mv)
            applied[i], told[i] = rng.choice([np.nan, 1e6, -1e6]), False
        if self.reads_back and (told.all() or self.known is not None):
            self.known = np.where(told, applied, before)  # each MV as it is read back: the loop goes on from there
        self.sample = Sample(
            pv=pv, mv_applied=applied if self.reads_back else None, dv=dv,
            age_s=float(rng.choice([0.0, 0.4, 5.0], p=[0.8, 0.19, 0.01])),
            fault="not trusted" if rng.random() < 0.003 else "",
            bad_pv=tuple(bad) if any(bad) else (), fresh=None if fresh.all() else fresh,
        )  # fmt: skip
        return self.sample

    def write(self, mv: Array) -> None:
        """What reaches the actuators; checked before anything else."""
        self._check(mv)
        if self.deaf or self.rng.random() < 0.005:
            self.deaf = max(self.deaf - 1, 0)
            raise EndpointError("refused")
        self.written = mv.copy()
        self.at = np.where(self.local, self.at, mv)

    def advance(self) -> None:
        """A period passes."""
        rng = self.rng
        if self.reads_back and self.local.any():
            moved = np.clip(self.at + 0.1 * self.span * rng.normal(size=len(self.at)), self.low, self.high)
            self.at = np.where(self.local & (rng.random(len(self.at)) < 0.2), moved, self.at)
        v = self.gain * (self.at - (self.low + self.high) / 2) / (self.span / 2)
        drive = np.concatenate([v, rng.uniform(-0.1, 0.1, self.kind.n_dv)])
        self.x = np.clip(self.model.advance(self.x, drive), -2 * TOP, 2 * TOP)

    def _broken(self) -> None:
        if self.rng.random() < 0.04:
            i = int(self.rng.integers(self.kind.n_y))
            how = str(self.rng.choice(["nan", "frozen", "jumped", "huge", "bad", "stale", "stale"]))
            self.broken[i] = (how, int(self.rng.choice([1, 3, 15, 40])))

    def _check(self, mv: Array) -> None:
        """In range, and no faster than its rate from where it is read back, or from the last command."""
        add = self.findings.add
        if not np.isfinite(mv).all():
            add("wrote no number", str(mv))
            return
        if (mv < self.low).any() or (mv > self.high).any():
            add("wrote out of range", str(mv))
        froms = [] if self.written is None else [self.written]
        froms += [] if self.known is None else [np.clip(self.known, self.low, self.high)]
        if froms:
            least = np.min([np.abs(mv - at) for at in froms], axis=0)
            if (least > self.most).any():
                add("wrote faster than its rate", f"{froms} to {mv} in {self.mode()}")
            moved = (least > (READ_BACK_MARGIN + ROUNDING) * self.span) & ~self.theirs()
            if self.mode() is Mode.HOLD and self.held and moved.any():
                add("HOLD moves", f"{froms} to {mv}")
        if self.mode() is Mode.SHADOW:
            add("SHADOW writes", str(mv))
