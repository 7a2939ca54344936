"""Loops a second of ``loopwright stress``: the law stepped by onnxruntime, and by its compiled plain C.

``python benchmarks/compiled_loops.py [FILE.onnx ...] [--rounds N] [--loops N]``: for each file, in rounds by turns,
loops a second of one process with onnxruntime and with the C, their ratio (the median of the rounds), the seconds until
the C can step (text, compiler, gate; nothing is kept), and those where it was kept. ``--levels 1 2 3`` puts the
compiler's levels -O1, -O2 and -O3 beside each other.

``--verdicts N``: the same N loops by both instead, how many verdicts differ, and by how much the figures do; and the
same for onnxruntime whose MV is off by up to 1e-12 of its range at each step, which says how much a loop amplifies.
``--search``: the seconds in which the search for the numbers of a PID runs all its candidates as torch, side by side,
and those until the C of a single candidate can step instead.
``--kit``: the largest difference between both over the conformance kit of each file instead, all shipped ones.
"""

from __future__ import annotations

import argparse
import math
import os
import statistics
import tempfile
import time
from dataclasses import replace
from pathlib import Path
from unittest import mock

import numpy as np

from loopwright.pipeline.cases import CASES
from loopwright.pipeline.evaluation.stress.draws import Drawing
from loopwright.pipeline.evaluation.stress.loops import Stress, StressOutcome
from loopwright.pipeline.export.gate import export
from loopwright.pipeline.export.plain_code.compiled_law import LEVEL, compiled_law
from loopwright.pipeline.laws import LAWS
from loopwright.pipeline.tuning.loop_search import DevelopmentLoops, LawStep, LoopCosts
from loopwright.serving import Controller

ARTIFACTS = Path(__file__).parents[1] / "artifacts"
# Loops of a turn: all that the command steps side by side, but of the slow ones.
LOOPS = {
    "ph_neutralization/pid": 100, "thiosulfate_cstr/inc": 100, "ph_neutralization/predictive": 100,
    "henson_seborg_cstr/predictive": 10,
}  # fmt: skip
NUDGE = 1e-12  # of an MV's range: above rounding's 2e-16, and below what the gate allows
BATCH = 100  # loops side by side, as in the command


def by_onnx(file: Path) -> Stress:
    """The loops of a shipped file, stepped by onnxruntime."""
    return Stress(Drawing(CASES[file.parent.name]), file.read_bytes())


def by_c(file: Path, level: str = LEVEL) -> tuple[Stress, float]:
    """The same, stepped by compiled C, and the seconds until it can."""
    controller, begun = Controller(file), time.perf_counter()
    law = compiled_law(controller, level)
    taken = time.perf_counter() - begun
    return Stress(Drawing(CASES[file.parent.name]), file.read_bytes(), compute=law.compute), taken


def rate(stress: Stress, loops: int) -> float:
    """Loops a second of ``loops`` loops, in batches as those of the command."""
    begun = time.perf_counter()
    for first in range(0, loops, BATCH):
        stress.outcomes(range(first, min(first + BATCH, loops)))
    return loops / (time.perf_counter() - begun)


def compare(file: Path, rounds: int, loops: int, levels: list[str]) -> None:
    """Print a row for each level."""
    sides = {level: by_c(file, level) for level in levels}
    kept = {level: by_c(file, level)[1] for level in levels}
    stresses = {"onnx": by_onnx(file), **{level: stress for level, (stress, _) in sides.items()}}
    for stress in stresses.values():
        rate(stress, 2)  # makes session, plant and library ready
    rates: dict[str, list[float]] = {side: [] for side in stresses}
    for _ in range(rounds):
        for side, stress in stresses.items():
            rates[side].append(rate(stress, loops))
    before = statistics.median(rates["onnx"])
    for level in levels:
        ratio = statistics.median(c / onnx for c, onnx in zip(rates[level], rates["onnx"], strict=True))
        print(
            f"{file.parent.name}/{file.stem:14s} {level} {loops:4d} loops: {before:8.2f} loops/s by onnxruntime, "
            f"{statistics.median(rates[level]):8.2f} by C, {ratio:5.2f} times; "
            f"{sides[level][1]:5.2f} s until the C can step, {kept[level]:5.2f} s where it was kept",
            flush=True,
        )


def verdict(one: StressOutcome) -> tuple[bool, ...]:
    """The part of an outcome that is no number."""
    return one.locked_up, one.left_limits, one.refused > 0, one.broke, one.swings


def parted(a: StressOutcome, b: StressOutcome) -> float:
    """The largest relative difference of the figures of one loop; infinite where one of both broke."""
    if a.broke or b.broke:
        return 0.0 if a.broke and b.broke else math.inf
    pairs = [(a.figures[name], b.figures[name]) for name in a.figures]
    return max((abs(x - y) / max(abs(x), abs(y)) for x, y in pairs if x != y), default=0.0)


def nudged(file: Path) -> Stress:
    """The loops by onnxruntime with other last digits."""
    controller, rng = Controller(file), np.random.default_rng(0)
    signals, place = controller.manifest.mv, controller.places["mv"]
    sizes = np.array([0.0 if s.values else NUDGE * (s.high - s.low) for s in signals])
    low, high = (np.array([getattr(s, end) for s in signals]) for end in ("low", "high"))

    def compute(given: np.ndarray) -> np.ndarray:
        taken = controller.compute(given)
        mv = taken[:, place]
        taken[:, place] = np.clip(mv + sizes * rng.uniform(-1, 1, mv.shape), low, high)
        return taken

    return replace(by_onnx(file), compute=compute)


def verdicts(file: Path, loops: int) -> None:
    """Print how the same loops end by onnxruntime, by C, and by onnxruntime with other last digits."""
    onnx = by_onnx(file).outcomes(range(loops))
    for side, stress in (("C", by_c(file)[0]), (f"{NUDGE:g} off", nudged(file))):
        pairs = list(zip(onnx, stress.outcomes(range(loops)), strict=True))
        failed, differ = ([a.index for a, b in pairs if of(a) != of(b)] for of in (lambda one: one.failed, verdict))
        gaps = sorted(parted(a, b) for a, b in pairs)
        name = f"{file.parent.name}/{file.stem:14s} {side:9s}"
        print(
            f"{name} {loops} loops: {len(failed)} fail by one alone, {len(differ)} "
            f"verdicts differ, swings included {differ[:10]}; figures differ by {statistics.median(gaps):.1e} in the "
            f"median loop, {gaps[-1]:.1e} in the worst, by more than 1e-6 in {sum(gap > 1e-6 for gap in gaps)}",
            flush=True,
        )


def search() -> None:
    """Print how long candidates of a PID take as they are, and how long one takes to become C."""
    law, case = LAWS["pid"], CASES["ph_neutralization"]
    taken: list[tuple[int, float]] = []

    class Timed(DevelopmentLoops):
        """Development loops that keep how many candidates ran, and for how long."""

        def run(self, step: LawStep, n_state: int, candidates: int = 1, *, time_weighted: bool = False) -> LoopCosts:
            begun = time.perf_counter()
            found = super().run(step, n_state, candidates, time_weighted=time_weighted)
            taken.append((candidates, time.perf_counter() - begun))
            return found

    params = law.Params(tuning="optimized", criterion="itae", development_seeds=(7001, 7002, 7003), development_hold=60)
    with (
        mock.patch("loopwright.pipeline.laws.pid.tuned.DevelopmentLoops", Timed),
        tempfile.TemporaryDirectory() as made,
    ):
        designed = law.design(params, {}, case.plant.signals, case.plant).eval()
        for name in ("first", "second"):  # the first export loads what the others find
            begun, file = time.perf_counter(), Path(made) / f"{name}.onnx"
            export(designed, file, case=case.name, provenance={})
            exported = time.perf_counter()
            compiled_law(Controller(file))
            ended = time.perf_counter()
    candidates, seconds = (sum(column) for column in zip(*taken, strict=True))
    print(
        f"{candidates} candidates over {len(params.development_seeds)} sequences as torch: {seconds:.2f} s; one "
        f"candidate until its C can step: {exported - begun:.2f} s for its file, {ended - exported:.2f} s for its C"
    )


def main() -> None:
    """Print the rows."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("files", metavar="FILE.onnx", type=Path, nargs="*")
    parser.add_argument("--rounds", type=int, default=5, help="by turns (5)")
    parser.add_argument("--loops", type=int, default=0, help="of a turn, the same ones each time (10 to 100, by file)")
    parser.add_argument("--levels", nargs="+", type="-O{}".format, default=[LEVEL], help=f"of the compiler ({LEVEL})")
    parser.add_argument("--verdicts", metavar="N", type=int, default=0, help="loops whose ends are compared")
    parser.add_argument("--kit", action="store_true", help="differences over the conformance kits")
    parser.add_argument("--search", action="store_true", help="a PID's search beside the making of its C")
    options = parser.parse_args()
    shipped = [f for f in sorted(ARTIFACTS.glob("*/*.onnx")) if f.parent.name in CASES and ".explain" not in f.name]
    every = options.files or (shipped if options.kit else [ARTIFACTS / f"{name}.onnx" for name in LOOPS])
    with tempfile.TemporaryDirectory() as kept:
        os.environ["XDG_CACHE_HOME"] = kept  # nothing is kept from an earlier run
        if options.search:
            search()
            return
        for file in every:
            if options.kit:
                law = compiled_law(Controller(file))
                print(f"{file.parent.name}/{file.stem:28s} {law.worst:.1e}", flush=True)
            elif options.verdicts:
                verdicts(file, options.verdicts)
            else:
                loops = options.loops or LOOPS.get(f"{file.parent.name}/{file.stem}", BATCH)
                compare(file, options.rounds, loops, options.levels)


if __name__ == "__main__":
    main()
