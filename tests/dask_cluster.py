"""Real processes of a Dask cluster, which see nothing of a client's files; fixtures for whoever imports them."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from processes import within

from loopwright.pipeline.engine.cluster import ADDRESS, connected, disconnect

ROOT = Path(__file__).parents[1]
QUIET = {"DASK_DISTRIBUTED__WORKER__DAEMON": "True"}


class Cluster:
    """Processes of `dask`, each in an empty folder of its own."""

    def __init__(self, folder: Path, sources: Path = ROOT) -> None:
        self.folder, self.processes = folder, list[subprocess.Popen[bytes]]()
        self.environment = {**QUIET, "PYTHONPATH": f"{sources}{os.pathsep}{ROOT / 'tests'}", "OMP_NUM_THREADS": "1"}
        self.file = folder / "scheduler.json"
        self.start("scheduler", "--host", "127.0.0.1", "--port", "0", "--no-dashboard", "--scheduler-file", self.file)
        # The scheduler opens the file, and fills it a moment later.
        assert within(60, lambda: self.file.exists() and self.file.read_text().rstrip().endswith("}"))

    def start(self, *arguments: object) -> None:
        empty = self.folder / f"empty{len(self.processes)}"
        empty.mkdir()
        command = [sys.executable, "-m", "dask", *map(str, arguments)]
        environment = {**os.environ, **self.environment}
        with (self.folder / f"{empty.name}.log").open("wb") as out:
            self.processes.append(
                subprocess.Popen(command, cwd=empty, env=environment, stdout=out, stderr=out, start_new_session=True)
            )

    def worker(self, *further: str) -> None:
        options = ("--nthreads", "1", "--no-dashboard", "--memory-limit", "0", *further)
        self.start("worker", "--scheduler-file", self.file, *options)

    def end(self) -> None:
        for process in reversed(self.processes):
            os.killpg(process.pid, signal.SIGTERM)
        for process in self.processes:
            try:
                process.wait(20)
            except subprocess.TimeoutExpired:  # a worker takes its leave of a scheduler that is gone already
                os.killpg(process.pid, signal.SIGKILL)
                process.wait()


@pytest.fixture(scope="module", name="cluster")
def two_workers(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Cluster]:
    """A scheduler with two workers, one of them without a preload; ``test_preload.py`` tests what it imports ahead."""
    made = Cluster(tmp_path_factory.mktemp("cluster"))
    try:
        made.worker("--preload", "quick_preload")
        made.worker()
        yield made
    finally:
        made.end()


@pytest.fixture(name="address")
def joined(cluster: Cluster, monkeypatch: pytest.MonkeyPatch) -> Iterator[str]:
    """The address of ``cluster`` with its two workers, as the one that work goes to."""
    found = str(json.loads(cluster.file.read_text())["address"])
    monkeypatch.setenv(ADDRESS, found)
    connected(found).wait_for_workers(2, timeout=60)
    try:
        yield found
    finally:
        disconnect()
