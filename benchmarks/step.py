"""A controller's step beside the perfect-model NMPC's, on this machine and in this run.

``python benchmarks/step.py [FILE.onnx ...]``; without files, every controller in artifacts/. It
prints a row a controller as it comes, and takes about ``--seconds`` in all.
Hot: called again at once. 10 ms loop: as the control loop calls it, every 10 ms and warmed just
before the deadline; unwarmed: as a host that does not warm it would. Each figure is the median of a
round, and of a controller's rounds the lowest: on a shared machine whole rounds run at half speed,
which says nothing of the controller. p99.9: of the hot steps that did not lose the processor to
other programs, and how many times the same round's median that is. A controller has ``--rounds``
rounds, more where it is over a limit and time is left, fewer where the time does not suffice. The
NMPC's figure is the median over the first samples of its case's first test, at most
``--nmpc-samples``.
"""

from __future__ import annotations

import argparse
import sys
import time
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from loopwright.pipeline.cases import CASES
from loopwright.pipeline.optimal.perfect import PerfectNmpc
from loopwright.serving import Controller, LoopwrightError
from loopwright.serving.card import bench


@dataclass(frozen=True)
class Limits:
    """What a law's step may cost [us], hot and warmed in a loop, and how much faster than the NMPC it must be.

    ``tail``: how many times the median the 99.9 % quantile may be.
    """

    hot: float
    loop: float
    ratio: float
    tail: float = np.inf  # of some 10 us an interrupt alone is several times the median


ONLINE = Limits(np.inf, 80.0, 100.0)  # a search within the step takes its time
NETWORK = Limits(40.0, 80.0, 100.0)  # the law is its network
# Laws that adapt or blend within the step, on plants whose NMPC is quicker: as their cases' reports ask.
ADAPTIVE = Limits(80.0, 160.0, 20.0)
SEARCHING = Limits(np.inf, 200.0, 20.0)
PLANNING = Limits(500.0, 500.0, 20.0, 3.0)  # two passes over a horizon, several MVs; or three with one
LIMITS = {
    **dict.fromkeys(("inc", "incad", "incadec", "inverse_dob"), NETWORK),
    **dict.fromkeys(("linearized_pid", "recursive_pid", "self_tuning_pid"), ADAPTIVE),
    **dict.fromkeys(("local_pid_network", "auto_pid_network"), ADAPTIVE),
    **dict.fromkeys(("fuzzy_feedforward", "fuzzy_feedforward_pi", "fuzzy_feedforward_observer"), ADAPTIVE),
    "predictive": PLANNING,
    **dict.fromkeys(("gauss_newton_pid", "minimum_variance"), SEARCHING),
}


LEAST_SAMPLES = 8  # of the NMPC, whatever they take
NMPC_SHARE = 0.3  # of the time
MORE = 3  # times the rounds, for a controller over its limits


def nmpc_median_us(case_name: str, samples: int, seconds: float) -> tuple[float, int]:
    """Median step [us] of the NMPC in closed loop over the first samples of the case's first test, and their number.

    It ends after ``samples`` or ``seconds``, but not before ``LEAST_SAMPLES``.
    """
    case = CASES[case_name]
    scenario = next(iter(case.scenarios().values()))[0]
    plant, ahead = (scenario.plant or case.plant).relaxed(), case.foreseen
    nmpc = PerfectNmpc(plant, case.criterion, replace(case.effort, every=1), case.limits)
    course = scenario.sp if scenario.reference is None or not ahead else scenario.reference
    simulate, p, x, times = plant.stepper(), plant.parameters(), scenario.x0, []
    started = time.monotonic()
    for k in range(min(samples, scenario.samples)):
        if k >= LEAST_SAMPLES and time.monotonic() - started > seconds:
            break
        # Given a recipe it sees what comes; without, each new set point would start its search afresh.
        sp = course[min(k + 1, scenario.samples - 1) :] if ahead else course[k]
        begun = time.perf_counter_ns()
        mv = nmpc.step(x, sp)
        times.append((time.perf_counter_ns() - begun) / 1e3)
        x = simulate(x, mv, plant.dv_nominal, p)
    return float(np.median(times)), len(times)


def complaints(law: str, hot: float, loop: float, ratio: float, tail: float) -> list[str]:
    """What of a controller's figures [us] is not what it must be."""
    limits, found = LIMITS.get(law, ONLINE), []
    if hot > limits.hot:
        found.append(f"hot over {limits.hot:g}")
    if loop > limits.loop:
        found.append(f"loop over {limits.loop:g}")
    if ratio < limits.ratio:
        found.append(f"less than {limits.ratio:g} times faster")
    if tail > limits.tail:
        found.append(f"p99.9 over {limits.tail:g} p50")
    return found


def measure(controller: Controller, nmpc_us: float, rounds: int, sizes: dict[str, int], seconds: float) -> bool:
    """Print a controller's row; False where a figure is not what it must be."""
    started, law, best, done = time.monotonic(), controller.manifest.law, np.full(5, np.inf), 0
    while True:
        timings = bench(controller, **sizes)
        alone = timings[0].alone
        best = np.fmin(best, [*(t.p50 for t in timings), alone, alone / timings[0].p50])
        done += 1
        hot, loop, cold, late, tail = best
        verdict = complaints(law, hot, loop, nmpc_us / hot, tail)
        enough = done >= (MORE * rounds if verdict else rounds)
        if enough or time.monotonic() - started > seconds:
            break
    label = f"{controller.manifest.case}/{law}"
    row = f"{label:<46}{hot:>8.1f}{loop:>12.1f}{cold:>10.1f}{late:>8.1f}{tail:>5.1f}x{nmpc_us / hot:>11.0f}x{done:>8}"
    row += f"  {', '.join(verdict)}"
    print(row.rstrip(), flush=True)
    return not verdict


def main() -> int:
    """Print the table; 1 if a figure is not what it must be."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("files", nargs="*", type=Path, metavar="FILE")
    parser.add_argument("--seconds", type=float, default=140.0, help="about what all of it may take (140)")
    parser.add_argument("--nmpc-samples", type=int, default=60)
    parser.add_argument("--steps", type=int, default=1_000, help="of a round, hot")
    parser.add_argument("--loop-steps", type=int, default=30, help="of a round, every 10 ms")
    parser.add_argument("--rounds", type=int, default=3)
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
    end = time.monotonic() + options.seconds
    names = dict.fromkeys(c.manifest.case for c in controllers if c.manifest.case in CASES)
    print(
        f"step times of {len(controllers)} controllers and of {len(names)} perfect-model NMPCs; "
        f"about {options.seconds:.0f} s in all",
        flush=True,
    )
    nmpc = {}
    for name in names:
        share = NMPC_SHARE * options.seconds / len(names)
        nmpc[name], samples = nmpc_median_us(name, options.nmpc_samples, share)
        print(f"{name}: perfect-model NMPC, median step {nmpc[name] / 1e3:.2f} ms of {samples}", flush=True)
    head = f"{'step p50 [us]':<46}{'hot':>8}{'10 ms loop':>12}{'unwarmed':>10}"
    print(f"{head}{'p99.9':>8}{'/ hot':>6}{'NMPC / hot':>12}{'rounds':>8}")
    sizes = {"steps": options.steps, "loop_steps": options.loop_steps}
    good = True
    for left, c in zip(range(len(controllers), 0, -1), controllers, strict=True):
        seconds = max(0.0, end - time.monotonic()) / left
        good = measure(c, nmpc.get(c.manifest.case, np.nan), options.rounds, sizes, seconds) and good
    return 0 if good else 1


if __name__ == "__main__":
    sys.exit(main())
