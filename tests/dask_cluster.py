"""Real processes of a Dask cluster, which see nothing of a client's files."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from pathlib import Path

from processes import within

ROOT = Path(__file__).parents[1]
QUIET = {"DASK_DISTRIBUTED__WORKER__DAEMON": "True"}


class Cluster:
    """Processes of `dask`, each in an empty folder of its own."""

    def __init__(self, folder: Path, sources: Path = ROOT) -> None:
        self.folder, self.processes = folder, list[subprocess.Popen[bytes]]()
        self.environment = {**QUIET, "PYTHONPATH": f"{sources}{os.pathsep}{ROOT / 'tests'}", "OMP_NUM_THREADS": "1"}
        self.file = folder / "scheduler.json"
        self.start("scheduler", "--host", "127.0.0.1", "--port", "0", "--no-dashboard", "--scheduler-file", self.file)
        assert within(60, self.file.exists)

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
            process.wait(20)
