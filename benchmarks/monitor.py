"""What the monitor finds of a drift, how soon, and how often it cries wolf.

``python benchmarks/monitor.py [CASE ...] [--weeks 1]``: normal operation of every case with its exported controller
(set points that change now and then, slow loads that nobody measures, measurement noise; a batch case runs batches).
The monitor learns; from then on it is watched for ``--weeks`` without a drift, and, from the same moment on, with one
parameter 20 % lower or higher for at most ``--patience`` settling times. Printed: alarms without a drift, and for
each drift the first verdict that changed, and how long after. Of a drift that is not found: by how much it
changes what the loop measures and does, with the same loads and noise, as a share of what these scatter anyway.

Thresholds were chosen on seeds below 100 with ``--size 1 --speed 1``; the defaults are other seeds, and loads that are
half as large again and twice as fast. Plant, law and monitor are the real ones; the guards of a loop are left out.
"""

from __future__ import annotations

import argparse
import contextlib
import copy
import time
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from loopwright.pipeline.cases import CASES
from loopwright.serving import Command, Controller, Mode, Sample
from loopwright.serving.monitor import Monitor

ROOT = Path(__file__).parents[1]
WEEK_S, LOOK_S = 7 * 86_400.0, 10.0
DRIFT = 0.2
AHEAD = 1_000  # scans whose noise is drawn at once
LONGEST = 2_000_000  # periods until nothing is unknown any more
Array = NDArray[np.float64]


@dataclass(frozen=True)
class Plan:
    """A case's law, its normal loads (share of the parameter), the parameters that drift, and its pace.

    A set point holds 5 paces and more, 15 on average; loads have a correlation time of 20 paces [periods]. A batch
    case has loads that differ from batch to batch, and no pace.
    """

    law: str
    loads: dict[str, float]
    drifts: tuple[str, ...]
    pace: int = 0


PLANS = {
    "thiosulfate_cstr": Plan("forward_dob", {"T_in": 0.002, "CA_in": 0.005}, ("UA", "k0", "F", "minus_dH"), 20),
    "ph_neutralization": Plan("predictive", {"q2": 0.02, "Wa2": 0.005}, ("Cv", "q1", "Wb2", "A"), 20),
    "ph_neutralization_15s": Plan("predictive", {"q2": 0.02, "Wa2": 0.005}, ("Cv", "q1", "Wb2", "A"), 60),
    "henson_seborg_cstr": Plan("predictive", {"T_f": 0.001, "C_f": 0.002}, ("K1", "q"), 40),
    "reversible_cstr": Plan("model_reference", {"T_in": 0.002, "C_t": 0.002}, ("h", "k1", "beta", "V"), 100),
    "batch_reactor": Plan("predictive", {"alpha1": 0.01}, ("gamma1", "beta1", "A10")),
    "jacketed_batch_reactor": Plan("fuzzy_feedforward_observer", {"T_0": 0.02}, ("a_c", "a_w", "phi", "a_0")),
}
Scan = tuple[Sample | None, Command]


class Law:
    """What an operation shares with its copies: the plant and the controller, which keep nothing."""

    def __init__(self, name: str) -> None:
        self.case, self.plan = CASES[name], PLANS[name]
        self.plant = self.case.plant
        self.controller = Controller(ROOT / "artifacts" / name / f"{self.plan.law}.onnx")
        self.step = self.plant.stepper()
        self.base = self.plant.parameters()
        names = list(self.plant.parameter_names())
        self.loaded = [names.index(n) for n in self.plan.loads]
        self.sd = np.array(list(self.plan.loads.values()))
        self.place = names.index

    def __deepcopy__(self, memo: dict[int, Any]) -> Law:
        return self

    @cached_property
    def recipe(self) -> Array:
        """Set points of the first test (n, n_sp): a batch."""
        return self.test.sp[:, : len(self.plant.sp_signals)]

    @cached_property
    def test(self) -> Any:
        """The first test."""
        return next(iter(self.case.scenarios().values()))[0]

    @cached_property
    def span(self) -> tuple[Array, Array]:
        """Set points of normal operation lie between these."""
        n = len(self.plant.sp_signals)
        points = np.concatenate([t.sp[:, :n] for tests in self.case.scenarios().values() for t in tests])
        low, high = np.quantile(points, [0.1, 0.9], axis=0)
        return low, high


@dataclass
class Operation:
    """Normal operation, scan by scan; a copy goes on from the same moment. ``drift``: (parameter, share)."""

    law: Law
    rng: np.random.Generator
    size: float = 1.0
    speed: float = 1.0
    drift: tuple[str, float] | None = None
    k: int = 0
    left: int = 0  # periods of the present set point, or of the batch
    sp: Array = field(default_factory=lambda: np.zeros(0))
    x: Array = field(default_factory=lambda: np.zeros(0))
    loads: np.random.Generator = field(default_factory=lambda: np.random.default_rng(0))

    def __post_init__(self) -> None:
        self.load = np.zeros(len(self.law.sd))
        self.noise, self.dv = np.zeros((0, 0)), self.law.plant.dv_nominal
        self._start()
        self.sp = self.rng.uniform(*self.law.span)
        self.set_parameters()

    def set_parameters(self) -> None:
        """The plant's parameters with the present loads and the drift."""
        self.p = self.law.base.copy()
        self.p[self.law.loaded] *= 1 + self.size * self.law.sd * np.clip(self.load, -3, 3)
        if self.drift is not None:
            self.p[self.law.place(self.drift[0])] *= 1 + self.drift[1]

    def scans(self) -> list[Scan]:
        """The next scan; before a batch one in SHADOW."""
        law, found, i = self.law, list[Scan](), self.k % AHEAD
        if i == 0:
            std = law.case.noise_std
            self.noise = std * self.rng.normal(size=(AHEAD, len(std)))
        if law.plan.pace:
            self._wander(law.plan.pace)
        else:
            if self.left == 0:
                if self.k:
                    found.append((None, Command(self.k, Mode.SHADOW, self.sp, self.mv, None, None)))
                self._start()
                self.left = len(law.recipe)
                self.load = self.loads.normal(size=len(self.load))
                self.set_parameters()
            self.sp = law.recipe[-self.left]
        self.left -= 1
        pv, applied = law.plant.measure(self.x) + self.noise[i], self.mv
        self.mv, self.state, info = law.controller.step(
            sp=self.sp, pv=pv, dv=self.dv, mv_applied=applied, state=self.state
        )
        self.x = law.step(self.x, self.mv, self.dv, self.p)
        self.k += 1
        found.append((Sample(pv, applied, self.dv), Command(self.k, Mode.AUTO, self.sp, self.mv, self.mv, info)))
        return found

    def _start(self) -> None:
        test = self.law.test
        self.x, self.mv, self.state = test.x0.copy(), test.mv0.copy(), self.law.controller.cold_state()

    def _wander(self, pace: int) -> None:
        if self.left <= 0:
            self.sp = self.rng.uniform(*self.law.span)
            self.left = int(pace * (5 + self.rng.exponential(10)))
        every = pace // 5  # a hundredth of the correlation time, at speed 1
        if self.k % every == 0:
            slow = self.speed * every / (20 * pace)
            self.load = self.load * (1 - slow) + np.sqrt(2 * slow) * self.loads.normal(size=len(self.load))
            self.set_parameters()


class Watched:
    """An operation and its monitor: alarms are (period, verdict, level, text) of each change to one."""

    def __init__(self, operation: Operation) -> None:
        self.operation = operation
        self.monitor = Monitor(operation.law.controller.manifest, started_s=0.0)
        self.period_s = operation.law.controller.manifest.period_s
        self.look = max(round(LOOK_S / self.period_s), 1)  # as the station looks
        self.levels = dict[str, str]()
        self.alarms = list[tuple[int, str, str, str]]()

    @property
    def known(self) -> bool:
        """Whether nothing is unknown any more."""
        batch = not self.operation.law.plan.pace
        return bool(self.levels) and self.monitor.batches.known == batch and "not known yet" not in self.levels.values()

    def scan(self) -> bool:
        """One period; whether an alarm began."""
        k, before = self.operation.k, len(self.alarms)
        for sample, command in self.operation.scans():
            self.monitor.observe(k * self.period_s, sample, command)
        if k % self.look == 0:
            verdicts = self.monitor.verdicts()
            for v in verdicts:
                if v.level in {"watch", "retrain"} and self.levels.get(v.name) not in {v.level, "retrain"}:
                    self.alarms.append((k, v.name, v.level, v.text))
            self.levels = {v.name: v.level for v in verdicts}
        return len(self.alarms) > before


def learnt(name: str, seed: int, size: float = 1.0, speed: float = 1.0) -> Watched:
    """Normal operation until nothing is unknown any more."""
    rng, loads = np.random.default_rng(seed), np.random.default_rng([seed, 1])
    watched = Watched(Operation(Law(name), rng, size, speed, loads=loads))
    while not watched.known:
        if watched.operation.k > LONGEST:
            raise RuntimeError(f"{name}: still unknown after {LONGEST} periods: {watched.levels}")
        watched.scan()
    return watched


def drifted(watched: Watched, drift: tuple[str, float], most: int, seed: int) -> list[tuple[int, str, str, str]]:
    """The alarms of the first look that has one, of a copy of ``watched`` with a drift from now on."""
    other = copy.deepcopy(watched)
    other.operation.drift, other.operation.rng = drift, np.random.default_rng(seed)
    other.operation.set_parameters()
    began, before = other.operation.k, len(other.alarms)
    for _ in range(most):
        if other.scan():
            return [(k - began, *rest) for k, *rest in other.alarms[before:]]
    return []


def effect(law: Law, drift: tuple[str, float], periods: int, seed: int) -> str:
    """What a drift changes while set points, loads and noise are the same, beside noise and beside other loads.

    Root mean squares over the run: each PV's over its measurement noise, each MV's over what other loads change.
    """

    def course(drift: tuple[str, float] | None, loads: int) -> tuple[Array, Array]:
        operation = Operation(law, np.random.default_rng(seed), drift=drift, loads=np.random.default_rng(loads))
        scans = [operation.scans()[-1] for _ in range(periods)]
        return np.array([s.pv for s, _ in scans if s is not None]), np.array([c.mv for _, c in scans])

    (pv, mv), (pv_drift, mv_drift), (_, mv_loads) = course(None, seed), course(drift, seed), course(None, seed + 1)

    def rms(x: Array) -> Array:
        return np.sqrt(np.mean(x**2, axis=0)) + 1e-12

    pvs, mvs = rms(pv_drift - pv) / law.case.noise_std, rms(mv_drift - mv) / rms(mv_loads - mv)
    rows = [f"{s.name} by {v:.2g} of its noise" for s, v in zip(law.plant.pv_signals, pvs, strict=True)]
    rows += [f"{s.name} by {v:.2g} of what loads do" for s, v in zip(law.plant.mv_signals, mvs, strict=True)]
    return ", ".join(rows)


def main() -> None:
    """Run and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("cases", nargs="*", metavar="CASE", default=list(PLANS))
    parser.add_argument("--weeks", type=float, default=1.0, help="watched without a drift (%(default)s)")
    parser.add_argument("--patience", type=float, default=7.0, help="most days of a drift (%(default)s)")
    parser.add_argument("--most", type=int, default=100_000, help="most periods of a drift (%(default)s)")
    parser.add_argument("--seed", type=int, default=100)
    parser.add_argument("--size", type=float, default=1.5, help="of the loads (%(default)s)")
    parser.add_argument("--speed", type=float, default=2.0, help="of the loads (%(default)s)")
    options = parser.parse_args()
    for name in options.cases:
        watched = learnt(name, options.seed, options.size, options.speed)
        period, began = watched.period_s, watched.operation.k
        print(f"{name} ({PLANS[name].law}, {period:g} s): learnt in {began} periods ({began * period / 86_400:.2f} d), "
              f"{len(watched.alarms)} alarms till then", flush=True)  # fmt: skip
        most = min(int(options.patience * 86_400 / period), options.most)
        for i, drift in enumerate((p, s * DRIFT) for p in PLANS[name].drifts for s in (-1, 1)):
            alarms = drifted(watched, drift, most, options.seed + 1 + i)
            if not alarms:
                words = f"not found in {most} periods; it changes {effect(watched.operation.law, drift, 4_000, 1)}"
            else:
                found = alarms[-1]
                words = f"{found[0]} periods ({found[0] * period / 3600:.2f} h): {found[1]}: {found[2]}: {found[3]}"
            print(f"  {drift[0]} {drift[1]:+.0%}: {words}", flush=True)
        quiet(watched, options.weeks)


def quiet(watched: Watched, weeks: float) -> None:
    """Go on without a drift, and print the alarms; Ctrl-C ends it early."""
    before, began, period = len(watched.alarms), watched.operation.k, watched.period_s
    with contextlib.suppress(KeyboardInterrupt):
        for _ in range(int(weeks * WEEK_S / period)):
            if watched.scan():
                print(f"  false: {watched.alarms[-1]}", flush=True)
    done = (watched.operation.k - began) * period / WEEK_S
    scans = [scan for _ in range(1_000) for scan in watched.operation.scans()]
    tick = time.process_time()
    for sample, command in scans:
        watched.monitor.observe(command.scan * period, sample, command)
    cost = (time.process_time() - tick) / len(scans)
    print(f"  {len(watched.alarms) - before} false alarms in {done:.2f} weeks; {1e6 * cost:.0f} us a scan", flush=True)


if __name__ == "__main__":
    main()
