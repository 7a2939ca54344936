"""The cluster that does a run's work: one of this machine's cores, or the one that DASK_SCHEDULER_ADDRESS names.

TLS and all else of the connection is set as Dask sets it (``DASK_DISTRIBUTED__COMM__TLS__...``).
"""

from __future__ import annotations

import contextlib
import logging
import os
import sys
import tempfile
from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING

from loopwright.pipeline.errors import PipelineError

if TYPE_CHECKING:
    from distributed import Client, Worker

ADDRESS = "DASK_SCHEDULER_ADDRESS"
WORKERS = "LOOPWRIGHT_WORKERS"  # how many a cluster of this machine has where nobody says it; unset: one a core
CONNECT_S = 20.0  # [s] until a scheduler must have answered
WORKERS_S = 120.0  # for the first worker, whose libraries take some seconds
# Set for the workers of a cluster of this machine: kinds of stages, with commas, that it is for. Unset: any may come.
STAGES = "LOOPWRIGHT_STAGES"
PROFILING = ("profile", "profile-cycle")  # callbacks of a worker
PRELOAD = ["loopwright.pipeline.engine.preload"]
# What workers have in their environment before they start. They keep memory that is freed: Dask has them give it back
# to the system at once, and the pages that it then has to clear anew took up to a third of a training's time.
MEMORY = {
    "MALLOC_MMAP_MAX_": "0",  # large arrays come from the kept memory, too
    "MALLOC_TRIM_THRESHOLD_": str(512 * 1024**2),  # bytes at the end of it that are kept
    "MALLOC_ARENA_MAX": "1",  # for all threads: one of them computes
}
# What a browser that goes away while its page is being made raises is logged here; nothing of the run depends on the
# page. Dask's own errors have loggers of their own.
OF_THE_PAGE = ("tornado.application", "bokeh", "asyncio")
# Read as distributed is imported. A long computation that holds the interpreter is no dead worker.
CONFIG = {
    **{f"distributed.nanny.pre-spawn-environ.{name}": value for name, value in MEMORY.items()},
    # Dask looks at itself 50 times a second in every process, which takes 3 % of two cores and interrupts the work.
    "distributed.admin.tick.interval": "2s",
    "distributed.admin.system-monitor.interval": "5s",
    "distributed.scheduler.worker-ttl": None,
    # Nobody reads what it samples a hundred times a second, also where no work is done; see ``preload.unwatched``.
    "distributed.worker.profile.enabled": False,
    "distributed.admin.large-graph-warning-threshold": "1GB",  # a stage's files are its arguments
    "logging.distributed": "critical",
    "logging.tornado": "critical",
}


@contextlib.contextmanager
def local_cluster(workers: int | None = None, say: Callable[[str], object] | None = None) -> Iterator[str]:
    """Workers of one thread on this machine (None: ``usual_workers``) until the block ends; its scheduler's address.

    ``say`` is told where a browser shows the work, where the package bokeh, which draws it, is installed. Without
    ``say`` nobody would know: nothing is drawn then, because that takes half a second to load.

    The address stands in the environment meanwhile, where whatever is started looks for it. The workers come in their
    own time: work that comes before them waits.
    """
    wanted = workers or usual_workers()
    import dask

    # For good: undone at the end, it would take the settings of distributed, which is imported within, with it.
    dask.config.set(CONFIG)
    from distributed import LocalCluster

    drawn = say is not None and _can_draw()
    if drawn:
        for name in OF_THE_PAGE:
            logging.getLogger(name).setLevel(logging.CRITICAL)
    with tempfile.TemporaryDirectory(prefix="loopwright-workers-", ignore_cleanup_errors=True) as folder:
        cluster = LocalCluster(
            n_workers=0,
            threads_per_worker=1,
            processes=True,
            host="127.0.0.1",
            dashboard_address="127.0.0.1:0",  # of its server of HTTP, which it has also where nothing is drawn
            scheduler_kwargs={"dashboard": drawn},
            memory_limit=0,
            local_directory=folder,
            preload=PRELOAD,
        )
        before = os.environ.get(ADDRESS)
        try:
            os.environ[ADDRESS] = cluster.scheduler_address
            cluster.scale(wanted)
            if say is not None and drawn:
                say(f"the work at a glance, in a browser: {cluster.dashboard_link}")
            yield cluster.scheduler_address
        finally:
            os.environ.pop(ADDRESS, None)
            if before is not None:
                os.environ[ADDRESS] = before
            disconnect()
            with contextlib.suppress(TimeoutError):  # of workers that are still starting, which end with us
                cluster.close(timeout=5)


def usual_workers() -> int:
    """The number of workers that WORKERS says, or one a core. Raises PipelineError where it says no number."""
    asked = os.environ.get(WORKERS, "")
    if asked and not (asked.isdecimal() and int(asked)):
        raise PipelineError(f"{WORKERS} is {asked!r}; it takes how many workers a run has here, 1 or more")
    return int(asked or os.cpu_count() or 1)


def workers_here(workers: int | None, option: str) -> contextlib.AbstractContextManager[object]:
    """Workers on this machine, as many as ``option`` asks for (None: it was left out), until the block ends.

    None for one alone, whose work is done in this process. Raises PipelineError where a cluster's address is set too.
    """
    if workers is not None and address() is not None:
        raise PipelineError(
            f"{option} is for this machine, but the work goes to the cluster at {address()}; "
            f"leave {option} out, or unset {ADDRESS}"
        )
    return contextlib.nullcontext() if workers is None or workers == 1 else local_cluster(workers)


def address() -> str | None:
    """The scheduler that work goes to; None where there is none, and work is done in place."""
    return os.environ.get(ADDRESS) or None


_connections = dict[str, "Client"]()


def disconnect() -> None:
    """End the connections of this process, with the threads that serve them."""
    while _connections:
        _connections.popitem()[1].close(timeout=5)


def connected(to: str) -> Client:
    """The connection of this process to a scheduler with workers. Raises PipelineError where none answers."""
    if to not in _connections:
        _connections[to] = _client(to)
    return _connections[to]


def _client(to: str) -> Client:
    import dask

    dask.config.set(CONFIG)
    from distributed import Client

    class Patient(Client):
        """A client that connects anew where the scheduler's first word came together with news for all clients."""

        async def _ensure_connected(self, timeout: float | None = None) -> None:
            try:
                await super()._ensure_connected(timeout=timeout)
            except AssertionError:
                self.id += "-again"  # the scheduler forgets the other one when its connection ends
                await super()._ensure_connected(timeout=timeout)

    try:
        client = Patient(to, timeout=CONNECT_S, set_as_default=False)
    except (OSError, TimeoutError, ValueError) as error:
        text = " ".join(str(error).split()) or type(error).__name__
        raise PipelineError(
            f"no scheduler answers at {to} ({text}); start it (`dask scheduler`), correct {ADDRESS}, "
            "or unset it to use this machine's cores"
        ) from None
    try:
        if not client.scheduler_info()["workers"]:
            print(
                f"the scheduler at {to} has no worker yet; waiting up to {WORKERS_S:.0f} s", file=sys.stderr, flush=True
            )
            client.wait_for_workers(1, timeout=WORKERS_S)
    except TimeoutError:
        client.close()
        raise PipelineError(
            f"the scheduler at {to} has had no worker for {WORKERS_S:.0f} s; start some "
            f"(`dask worker {to} --nthreads 1 --preload {PRELOAD[0]}`), or unset {ADDRESS} to use this machine's cores"
        ) from None
    return client


def _can_draw() -> bool:
    try:
        import bokeh  # noqa: F401
    except ImportError:
        return False
    return True


def unwatched(worker: Worker) -> None:
    """End Dask's sampling profiler of a worker; of one that was started without this module, a task does it.

    The profiler looks into the frames of running tasks. torch.export then now and then loses track of a tensor and
    fails: 4 of 40 first exports of a process did, and none of 120 without it.
    """
    for name in PROFILING:
        callback = worker.periodic_callbacks.pop(name, None)
        if callback is not None:
            worker.loop.add_callback(callback.stop)
