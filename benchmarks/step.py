"""A controller's step beside the perfect-model NMPC's, on this machine and in this run.

``python benchmarks/step.py [FILE.onnx ...]``; without files, every controller in artifacts/.
Hot: called again at once. Every 10 ms: as the control loop calls it, warmed just before the
deadline; and cold, as a host that does not warm it would. Each figure is the median of a round,
and of ``--rounds`` rounds over all controllers the lowest: on a shared machine whole rounds run
at half speed, which says nothing of the controller.
"""

from __future__ import annotations

import argparse
import sys
import time
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from pipeline.cases import CASES
from pipeline.optimal.perfect import PerfectNmpc
from serving import Controller, LoopwrightError
from serving.bench import bench


@dataclass(frozen=True)
class Limits:
    """What a law's step may cost [us], hot and warmed in a loop, and how much faster than the NMPC it must be."""

    hot: float
    loop: float
    ratio: float


ONLINE = Limits(np.inf, 80.0, 100.0)  # a search within the step takes its time
NETWORK = Limits(40.0, 80.0, 100.0)  # the law is its network
# Laws that adapt or blend within the step, on plants whose NMPC is quicker: as their cases' reports ask.
ADAPTIVE = Limits(80.0, 160.0, 20.0)
SEARCHING = Limits(np.inf, 200.0, 20.0)
LIMITS = {
    **dict.fromkeys(("inc", "incad", "incadec", "inverse_dob"), NETWORK),
    **dict.fromkeys(("linearized_pid", "recursive_pid", "self_tuning_pid"), ADAPTIVE),
    **dict.fromkeys(("local_pid_network", "auto_pid_network"), ADAPTIVE),
    **dict.fromkeys(("fuzzy_feedforward", "fuzzy_feedforward_pi", "fuzzy_feedforward_observer"), ADAPTIVE),
    **dict.fromkeys(("gauss_newton_pid", "minimum_variance"), SEARCHING),
}


def nmpc_median_us(case_name: str, samples: int) -> float:
    """Median step [us] of the NMPC in closed loop over the first samples of the case's first scenario."""
    case = CASES[case_name]
    scenario = next(iter(case.scenarios().values()))[0]
    plant, ahead = (scenario.plant or case.plant).relaxed(), case.foreseen
    nmpc = PerfectNmpc(plant, case.criterion, replace(case.effort, every=1), case.limits)
    course = scenario.sp if scenario.reference is None or not ahead else scenario.reference
    simulate, p, x, times = plant.stepper(), plant.parameters(), scenario.x0, []
    for k in range(min(samples, scenario.samples)):
        # Given a recipe it sees what comes; without, each new set point would start its search afresh.
        sp = course[min(k + 1, scenario.samples - 1) :] if ahead else course[k]
        begun = time.perf_counter_ns()
        mv = nmpc.step(x, sp)
        times.append((time.perf_counter_ns() - begun) / 1e3)
        x = simulate(x, mv, plant.dv_nominal, p)
    return float(np.median(times))


def main() -> int:
    """Print the table; 1 if a figure is not what it must be."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("files", nargs="*", type=Path, metavar="FILE")
    parser.add_argument("--nmpc-samples", type=int, default=160)
    parser.add_argument("--steps", type=int, default=5_000)
    parser.add_argument("--loop-steps", type=int, default=100)
    parser.add_argument("--rounds", type=int, default=8)
    options = parser.parse_args()
    files = options.files or sorted(Path("artifacts").glob("*/*.onnx"))
    if not files:
        print("no controllers in artifacts/; name some files", file=sys.stderr)
        return 2
    try:
        controllers = [Controller(file) for file in files]
    except LoopwrightError as error:
        print(error, file=sys.stderr)
        return 2
    names = dict.fromkeys(c.manifest.case for c in controllers if c.manifest.case in CASES)
    nmpc = {name: nmpc_median_us(name, options.nmpc_samples) for name in names}
    for name, median in nmpc.items():
        print(f"{name}: perfect-model NMPC, median step {median / 1e3:.2f} ms")
    print(f"{'step p50 [us]':<40}{'hot':>8}{'10 ms loop':>12}{'unwarmed':>10}{'NMPC / hot':>12}")
    good = True
    rounds = [
        [[t.p50 for t in bench(c, steps=options.steps, loop_steps=options.loop_steps)] for c in controllers]
        for _ in range(options.rounds)
    ]
    for c, (hot, warmed, cold) in zip(controllers, np.min(rounds, axis=0), strict=True):
        ratio = nmpc.get(c.manifest.case, np.nan) / hot
        verdict = []
        limits = LIMITS.get(c.manifest.law, ONLINE)
        if hot > limits.hot:
            verdict.append(f"hot over {limits.hot:g}")
        if warmed > limits.loop:
            verdict.append(f"loop over {limits.loop:g}")
        if ratio < limits.ratio:
            verdict.append(f"less than {limits.ratio:g} times faster")
        good = good and not verdict
        label = f"{c.manifest.case}/{c.manifest.law}"
        row = f"{label:<40}{hot:>8.1f}{warmed:>12.1f}{cold:>10.1f}{ratio:>11.0f}x  {', '.join(verdict)}"
        print(row.rstrip())
    return 0 if good else 1


if __name__ == "__main__":
    sys.exit(main())
