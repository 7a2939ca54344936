"""What the engine costs: the time of a piece of work that does nothing, and the start of a stage's client.

``python benchmarks/engine.py [--workers 2] [--pieces 2000]``, about two minutes. The client is started as DVC starts
it, with a stage that does not exist: its time is that of a process until the cluster has answered.
"""

from __future__ import annotations

import argparse
import os
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from loopwright.pipeline.engine.cluster import connected, local_cluster
from loopwright.pipeline.engine.parallel import parallel_map
from loopwright.pipeline.engine.preload import load

ROOT = Path(__file__).parents[1]
CLIENT = """
import os
from loopwright.pipeline.engine import remote
from loopwright.pipeline.engine.stage_files import StageFiles

remote.run_on({at!r}, ["nothing", "at_all"], StageFiles((), ()))
os._exit(0)
"""
ROUNDS, STARTS = 5, 12


def nothing(item: int) -> int:
    """A piece of no work."""
    return item


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--pieces", type=int, default=2_000)
    options = parser.parse_args()
    with local_cluster(options.workers) as at:
        connected(at).wait_for_workers(options.workers)
        connected(at).run(load)
        parallel_map(nothing, range(50), "to warm up")
        each, taken = list[float](), list[float]()
        for _ in range(ROUNDS):
            begun = time.perf_counter()
            parallel_map(nothing, range(options.pieces), "pieces of no work")
            each.append(1e3 * (time.perf_counter() - begun) / options.pieces)
        print(f"a piece: {statistics.median(each):.2f} ms ({min(each):.2f} to {max(each):.2f})", flush=True)
        command = [sys.executable, "-c", CLIENT.format(at=at)]
        with tempfile.TemporaryDirectory() as folder:
            for _ in range(STARTS):
                begun = time.perf_counter()
                environment = {**os.environ, "PYTHONPATH": str(ROOT / "tools/roots")}
                subprocess.run(command, cwd=folder, env=environment, check=True, capture_output=True)
                taken.append(time.perf_counter() - begun)
        print(f"a stage's client: {statistics.median(taken):.2f} s ({min(taken):.2f} to {max(taken):.2f})")


if __name__ == "__main__":
    main()
