"""What the monitor finds of a drift, and how often it cries wolf.

``python benchmarks/monitor.py [CASE ...] [--weeks 1] [--seed 100]``: normal operation of every case with its exported
controller (set points that change now and then, slow loads, measurement noise), first without a drift, then with one
parameter 20 % lower or higher from the middle on. Printed: false alarms a week, and for each drift the first verdict
that changed, how long after, in periods and in time. A batch case runs batches. Seeds below 100 served to choose the
thresholds; the default is none of them.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from pipeline.cases import CASES
from serving import Controller, ControlLoop, Mode, Sample
from serving.monitor import Monitor

ROOT = Path(__file__).parents[1]
WEEK_S = 7 * 86_400.0
LEARN_RESTS = 220  # settling times until all is learnt, twice over


@dataclass(frozen=True)
class Plan:
    """A case's law, its normal loads (share of the parameter, slow), and the parameters that drift."""

    law: str
    loads: dict[str, float]
    drifts: tuple[str, ...]


PLANS = {
    "thiosulfate_cstr": Plan("forward_dob", {"T_in": 0.002, "CA_in": 0.005}, ("UA", "k0", "F", "minus_dH")),
    "ph_neutralization": Plan("predictive", {"q2": 0.02, "Wa2": 0.005}, ("Cv", "q1", "Wb2", "A")),
    "ph_neutralization_15s": Plan("predictive", {"q2": 0.02, "Wa2": 0.005}, ("Cv", "q1", "Wb2", "A")),
    "henson_seborg_cstr": Plan("predictive", {"T_f": 0.001, "C_f": 0.002}, ("K1", "q")),
    "reversible_cstr": Plan("model_reference", {"T_in": 0.002, "C_t": 0.002}, ("h", "k1", "beta", "V")),
    "batch_reactor": Plan("predictive", {"alpha1": 0.01}, ("gamma1", "beta1", "A10")),
    "jacketed_batch_reactor": Plan("fuzzy_feedforward_observer", {"T_0": 0.02}, ("a_c", "a_w", "phi", "a_0")),
}
BATCHES = {"batch_reactor", "jacketed_batch_reactor"}
DRIFT = 0.2


@dataclass(frozen=True)
class Outcome:
    """What one run told: (periods after the drift, verdict, level, text) of each change to an alarm."""

    alarms: list[tuple[int, str, str, str]]
    periods: int
    known: int  # periods after which nothing was unknown any more; 0: never
    cost_us: float


def run(name: str, periods: int, drift: tuple[str, float] | None, seed: int) -> Outcome:
    """One run of normal operation; a drift comes at half of it."""
    plan = PLANS[name]
    controller = Controller(ROOT / "artifacts" / name / f"{plan.law}.onnx")
    monitor = Monitor(controller.manifest, started_s=0.0)
    period = controller.manifest.period_s
    last: dict[str, str] = {}
    alarms, known, cost = [], 0, 0.0
    scans = _batches if name in BATCHES else _weeks
    for k, sample, command in scans(name, controller, periods, drift, seed, monitor.settle):
        began = time.perf_counter()
        monitor.observe(k * period, sample, command)
        cost += time.perf_counter() - began
        if k % 50 == 0:
            for v in monitor.verdicts():
                if v.level in {"watch", "retrain"} and last.get(v.name) not in {v.level, "retrain"}:
                    alarms.append((k - periods // 2, v.name, v.level, v.text))
                last[v.name] = v.level
            if not known and all(level != "not known yet" for level in last.values()):
                known = k
    if monitor.trouble:
        alarms.append((0, "monitor", "failed", monitor.trouble))
    return Outcome(alarms, periods, known, 1e6 * cost / periods)


def _weeks(name, controller, periods, drift, seed, settle) -> Iterator:  # type: ignore[no-untyped-def]
    case, plan = CASES[name], PLANS[name]
    plant, rng = case.plant, np.random.default_rng(seed)
    points = np.concatenate([t.sp[:, : len(plant.sp_signals)] for ts in case.scenarios().values() for t in ts])
    low, high = np.quantile(points, [0.1, 0.9], axis=0)
    test = next(iter(case.scenarios().values()))[0]
    x, mv = test.x0.copy(), test.mv0.copy()
    sp = rng.uniform(low, high)
    loop = ControlLoop(controller, sp=sp, mv=mv, mode=Mode.AUTO, warm_lead_s=0)
    names, load = list(plan.loads), np.zeros(len(plan.loads))
    hold = 0
    base = plant.parameters()
    index = {n: i for i, n in enumerate(plant.parameter_names())}
    slow = 1 / (20 * settle)
    for k in range(periods):
        if hold <= 0:
            loop.set_sp(rng.uniform(low, high))
            hold = int(settle * (5 + rng.exponential(10)))
        hold -= 1
        load += -slow * load + np.sqrt(2 * slow) * rng.normal(size=len(load))
        p = base.copy()
        for n, value in zip(names, load, strict=True):
            p[index[n]] *= 1 + plan.loads[n] * np.clip(value, -3, 3)
        if drift is not None and k >= periods // 2:
            p[index[drift[0]]] *= 1 + drift[1]
        pv = plant.measure(x) + case.noise_std * rng.normal(size=len(case.noise_std))
        sample = Sample(pv, mv.copy(), plant.dv_nominal)
        command = loop.scan(sample)
        mv = command.mv
        x = plant.step(x, mv, plant.dv_nominal, p)
        yield k, sample, command


def _batches(name, controller, periods, drift, seed, settle) -> Iterator:  # type: ignore[no-untyped-def]
    case, plan = CASES[name], PLANS[name]
    plant, rng = case.plant, np.random.default_rng(seed)
    test = next(iter(case.scenarios().values()))[0]
    base = plant.parameters()
    index = {n: i for i, n in enumerate(plant.parameter_names())}
    loop = ControlLoop(controller, sp=test.sp[0, : len(plant.sp_signals)], mv=test.mv0, mode=Mode.AUTO, warm_lead_s=0)
    k = 0
    while k < periods:
        x, mv = test.x0.copy(), test.mv0.copy()
        p = base.copy()
        for n, sd in plan.loads.items():
            p[index[n]] *= 1 + sd * np.clip(rng.normal(), -3, 3)
        loop.set_mode(Mode.SHADOW)
        yield k, None, loop.scan(Sample(plant.measure(x), mv, plant.dv_nominal))
        loop = ControlLoop(controller, sp=test.sp[0, : len(plant.sp_signals)], mv=mv, mode=Mode.AUTO, warm_lead_s=0)
        for row in test.sp:
            if k >= periods:
                break
            if drift is not None and k >= periods // 2:
                p[index[drift[0]]] = base[index[drift[0]]] * (1 + drift[1])
            loop.set_sp(row[: len(plant.sp_signals)])
            pv = plant.measure(x) + case.noise_std * rng.normal(size=len(case.noise_std))
            sample = Sample(pv, mv.copy(), plant.dv_nominal)
            command = loop.scan(sample)
            mv = command.mv
            x = plant.step(x, mv, plant.dv_nominal, p)
            k += 1
            yield k, sample, command


def main() -> None:
    """Run and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("cases", nargs="*", metavar="CASE", default=list(PLANS))
    parser.add_argument("--weeks", type=float, default=1.0, help="without a drift (%(default)s)")
    parser.add_argument("--settles", type=int, default=1000, help="settling times of a run with a drift (%(default)s)")
    parser.add_argument("--seed", type=int, default=100)
    parser.add_argument("--most", type=int, default=1_300_000, help="periods of a run (%(default)s)")
    parser.add_argument("-v", "--verbose", action="store_true")
    options = parser.parse_args()
    with ProcessPoolExecutor(2) as pool:
        for name in options.cases:
            manifest = Controller(ROOT / "artifacts" / name / f"{PLANS[name].law}.onnx").manifest
            settle = Monitor(manifest, started_s=0.0).settle
            quiet_periods = min(int(options.weeks * WEEK_S / manifest.period_s), options.most)
            periods = min(max(options.settles * settle, 80_000), options.most)
            kinds = [(p, s * DRIFT) for p in PLANS[name].drifts for s in (-1, 1)]
            quiet = pool.submit(run, name, max(quiet_periods, periods), None, options.seed)
            jobs = [pool.submit(run, name, periods, d, options.seed + 1 + i) for i, d in enumerate(kinds)]
            told = quiet.result()
            weeks = told.periods * manifest.period_s / WEEK_S
            print(f"{name} ({manifest.law}, {manifest.period_s:g} s, settles in {settle} periods): known after "
                  f"{told.known} periods; {len(told.alarms)} false alarms in {weeks:.2f} weeks; "
                  f"{told.cost_us:.0f} us a scan", flush=True)  # fmt: skip
            for alarm in told.alarms[: 99 if options.verbose else 4]:
                print(f"    false: {alarm}")
            for (parameter, share), job in zip(kinds, jobs, strict=True):
                found = job.result()
                after = [a for a in found.alarms if a[0] >= 0]
                early = len(found.alarms) - len(after)
                if not after:
                    words = "not found"
                else:
                    k, verdict, level, text = after[0]
                    words = f"{k} periods ({k * manifest.period_s / 3600:.2f} h): {verdict}: {level}: {text}"
                print(f"  {parameter} {share:+.0%}: {words}" + (f"  [{early} before it]" if early else ""), flush=True)
                if options.verbose:
                    for a in after[1:]:
                        print(f"      then {a}")


if __name__ == "__main__":
    main()
