"""Loops a second of ``loopwright stress``, and how they grow with workers.

``python benchmarks/stress.py [FILE.onnx ...]``: loops a second of one process for each file, and the law's share of the
time. Then, for the first file, in ``--rounds`` rounds by turns: one worker, two workers, and two processes side by side
without the engine. Two workers over twice one worker say what two cores give here and now, other programs included; two
workers over the two processes say what the engine costs. At last a model: the makespan of ``--plants`` loops on 2 to
128 workers by a simulated clock. Its task times are those measured here; its scheduler hands out one task at a time and
takes the measured time of an empty task for it; its workers are alike and never wait for the network. A measured point
takes about ``--seconds``.
"""

from __future__ import annotations

import argparse
import heapq
import multiprocessing
import statistics
import time
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from loopwright.pipeline.cases import CASES
from loopwright.pipeline.engine.cluster import connected, local_cluster
from loopwright.pipeline.engine.parallel import parallel_map
from loopwright.pipeline.engine.preload import load
from loopwright.pipeline.evaluation.stress.draws import Drawing
from loopwright.pipeline.evaluation.stress.loops import Stress

FILES = ("ph_neutralization/pid", "ph_neutralization/predictive", "henson_seborg_cstr/pid")
BATCH = 20  # loops of a piece while workers are compared
EMPTY = 200  # empty tasks
WORKERS = (2, 8, 32, 128)
BAR = 0.85  # of the sum of two workers that run alone


def seconds_of(stress: Stress, indices: Sequence[int]) -> float:
    """Time of one piece where it runs [s]."""
    begun = time.perf_counter()
    stress.outcomes(indices)
    return time.perf_counter() - begun


def nothing(i: int) -> int:
    """An empty task."""
    return i


def pieces(plants: int, batch: int) -> list[range]:
    """The loops 0 to ``plants`` - 1 in pieces."""
    return [range(i, min(i + batch, plants)) for i in range(0, plants, batch)]


def alone(file: Path, seconds: float) -> tuple[Stress, float]:
    """Loops a second of this process, after a first batch that is not counted."""
    stress = Stress(Drawing(CASES[file.parent.name]), file.read_bytes())
    first = seconds_of(stress, range(BATCH))
    first = min(first, seconds_of(stress, range(BATCH)))
    count = max(int(BATCH * seconds / first), BATCH)
    taken = sum(seconds_of(stress, piece) for piece in pieces(count, 100))
    return stress, count / taken


def law_share(stress: Stress) -> float:
    """Share of a batch's time that is the steps of the law, its session included."""
    from loopwright.serving.vectorized_controller import VectorizedController

    whole, spent = VectorizedController.step, 0.0

    def timed(rows: VectorizedController, **given: np.ndarray) -> object:
        nonlocal spent
        begun = time.perf_counter()
        try:
            return whole(rows, **given)
        finally:
            spent += time.perf_counter() - begun

    VectorizedController.step = timed  # type: ignore[method-assign, assignment]
    try:
        taken = seconds_of(stress, range(100))
    finally:
        VectorizedController.step = whole  # type: ignore[method-assign]
    return spent / taken


def on_workers(stress: Stress, workers: int, plants: int) -> float:
    """Loops a second of a warm cluster."""
    with local_cluster(workers) as at:
        connected(at).wait_for_workers(workers, timeout=120)
        connected(at).run(load)
        parallel_map(partial(seconds_of, stress), pieces(2 * BATCH * workers, BATCH), "warm")
        begun = time.perf_counter()
        parallel_map(partial(seconds_of, stress), pieces(plants, BATCH), f"{workers} workers")
        return plants / (time.perf_counter() - begun)


def side_by_side(file: Path, plants: int) -> float:
    """Loops a second, together, of two processes that know nothing of each other."""
    context = multiprocessing.get_context("spawn")
    gate, rates = context.Barrier(2), context.SimpleQueue()
    processes = [context.Process(target=_by_itself, args=(file, plants // 2, gate, rates)) for _ in range(2)]
    for process in processes:
        process.start()
    total = sum(rates.get() for _ in processes)
    for process in processes:
        process.join()
    return total


def _by_itself(file: Path, plants: int, gate: Any, rates: Any) -> None:
    stress = Stress(Drawing(CASES[file.parent.name]), file.read_bytes())
    seconds_of(stress, range(2 * BATCH))
    gate.wait()
    begun = time.perf_counter()
    for piece in pieces(plants, BATCH):
        stress.outcomes(piece)
    rates.put(plants / (time.perf_counter() - begun))


def empty_task_s() -> float:
    """Time of an empty task through client, scheduler and worker, many at once [s]."""
    with local_cluster(1) as at:
        connected(at).wait_for_workers(1, timeout=120)
        connected(at).run(load)
        parallel_map(nothing, range(EMPTY), "warm")
        begun = time.perf_counter()
        parallel_map(nothing, range(EMPTY), "empty")
        return (time.perf_counter() - begun) / EMPTY


def makespan(tasks: Sequence[float], workers: int, overhead: float) -> float:
    """Time [s] until all tasks end: each goes to the worker that is free first, ``overhead`` after the one before."""
    free, handed = [0.0] * workers, 0.0
    for task in tasks:
        handed += overhead
        heapq.heapreplace(free, max(handed, free[0]) + task)
    return max(free)


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__)
    artifacts = Path(__file__).parents[1] / "artifacts"
    files = [artifacts / f"{name}.onnx" for name in FILES]
    parser.add_argument("files", metavar="FILE.onnx", type=Path, nargs="*", default=files)
    parser.add_argument("--seconds", type=float, default=6.0, help="of a measured point (6)")
    parser.add_argument("--rounds", type=int, default=3, help="of one and two workers (3)")
    parser.add_argument("--plants", type=int, default=10_000, help="of the model (10000)")
    options = parser.parse_args()
    print(f"{'file':34} {'loops/s':>8} {'samples/s':>10} {'law':>6}")
    compared: tuple[Stress, float] | None = None
    for file in options.files:
        stress, rate = alone(file, options.seconds)
        compared = compared or (stress, rate)
        samples = np.mean([draw.scenario.samples for draw in stress.drawing.draws(range(100))])
        name = f"{file.parent.name}/{file.stem}"
        print(f"{name:34} {rate:8.1f} {rate * samples:10.0f} {100 * law_share(stress):5.0f} %", flush=True)
    assert compared is not None
    stress, rate = compared
    shares = []
    for _ in range(options.rounds):
        count = int(2 * rate * options.seconds)
        one, two = on_workers(stress, 1, count // 2), on_workers(stress, 2, count)
        plain = side_by_side(options.files[0], count)
        shares.append((two / (2 * one), two / plain))
        print(f"loops/s: one worker {one:.1f}, two workers {two:.1f}, two plain processes {plain:.1f}", flush=True)
    twice, plainly = (100 * statistics.median(column) for column in zip(*shares, strict=True))
    print(f"two workers: {twice:.0f} % of twice one worker, {plainly:.0f} % of two plain processes")
    print(f"({100 * BAR:.0f} % is asked; medians)")
    overhead = empty_task_s()
    print(f"an empty task: {1e3 * overhead:.2f} ms")
    for batch in (20, 100):
        known = [seconds_of(stress, piece) for piece in pieces(5 * batch, batch)]
        tasks = np.random.default_rng(0).choice(known, -(-options.plants // batch))
        rows = [(w, makespan(tasks, w, overhead)) for w in WORKERS]
        grown = ", ".join(f"{w}: {sum(tasks) / t:.1f} x ({100 * sum(tasks) / t / w:.0f} %)" for w, t in rows)
        print(f"model, {options.plants} loops in pieces of {batch}, workers: speed-up (share): {grown}", flush=True)


if __name__ == "__main__":
    main()
