"""Where the time of a controller's step goes: the graph, and each check and copy of Python around it.

``python benchmarks/step_parts.py [FILE.onnx ...]``; without files, a small and a large controller of artifacts/. Each
part is what ``loopwright.serving.controller.Controller.step`` does, by itself, in the same process and in turn with the
others; figures are the lowest median of ``--rounds`` rounds [us]. What no row has is the call of ``step`` and its
keywords.
"""

from __future__ import annotations

import argparse
import statistics
import time
from collections.abc import Callable
from math import isfinite
from pathlib import Path

import numpy as np

from loopwright.serving.controller import Controller, Step

ARTIFACTS = Path(__file__).parents[1] / "artifacts"
SHOWN = ("ph_neutralization/pid.onnx", "ph_neutralization/gauss_newton_pid.onnx", "ph_neutralization/predictive.onnx")
CALLS = 400  # of a part in a round


def parts_of(controller: Controller) -> dict[str, Callable[[], object]]:
    """What a step does, part by part; each call is one step's share."""
    state = controller.cold_state()
    given = {name: buffer.copy() for _, name, buffer, _ in controller._inputs}
    controller.step(**given)  # so that the outputs are some
    inputs, buffer, lock = controller._inputs, controller._in, controller._lock
    place = tuple(given.get(name, state) for name in ("sp", "pv", "dv", "mv_applied", "state"))
    values, float64 = controller._out.tolist(), np.dtype(np.float64)
    n_mv, a, b, c, d = controller._cuts

    def copied() -> None:
        for i, _, part, shape in inputs:
            value = place[i]
            if type(value) is np.ndarray and value.dtype is float64 and value.shape == shape:
                part[...] = value

    def locked() -> None:
        with lock:
            pass

    def within() -> None:
        for value, (low, high, allowed) in zip(values, controller._ranges, strict=False):
            if not low <= value <= high or (allowed is not None and value not in allowed):
                raise AssertionError

    def step() -> Step:
        out = controller._out
        return Step(out[:n_mv], out[a:b], out[c:d])

    return {
        "whole step": lambda: controller.step(**given),
        "run of the session, its buffers bound": lambda: controller._session.run_with_iobinding(controller._binding),
        "lock": locked,
        "types and shapes of the inputs, copies into the buffer": copied,
        "inputs are finite": lambda: isfinite(sum(buffer.tolist())),
        "copy of the outputs": lambda: controller._out.copy().tolist(),
        "outputs are within their ranges": within,
        "outputs are finite": lambda: isfinite(sum(values)),
        "views of MV, state and info": step,
    }


def main() -> None:
    """Measure and print a table a controller."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("files", nargs="*", type=Path)
    parser.add_argument("--rounds", type=int, default=40)
    options = parser.parse_args()
    for path in options.files or [ARTIFACTS / name for name in SHOWN]:
        controller = Controller(path)
        best = dict.fromkeys(parts := parts_of(controller), float("inf"))
        for _ in range(options.rounds):
            for name, part in parts.items():
                taken = []
                for _ in range(CALLS):
                    begun = time.perf_counter_ns()
                    part()
                    taken.append(time.perf_counter_ns() - begun)
                best[name] = min(best[name], statistics.median(taken) / 1e3)
        nothing = _clock()
        print(f"{path.parent.name}/{path.name}: {controller.manifest.n_state} states")
        for name, us in best.items():
            print(f"  {name:<56} {us - nothing:6.2f}")


def _clock() -> float:
    """Time of a look at the clock and an empty call [us], which all rows hold."""
    taken = []
    for _ in range(10 * CALLS):
        begun = time.perf_counter_ns()
        (lambda: None)()
        taken.append(time.perf_counter_ns() - begun)
    return statistics.median(taken) / 1e3


if __name__ == "__main__":
    main()
