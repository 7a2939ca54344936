"""Independent pieces of one stage, side by side, with a line of progress."""

from __future__ import annotations

import os
from collections import deque
from collections.abc import Callable, Iterable
from concurrent.futures import FIRST_EXCEPTION, Future, wait
from contextlib import ExitStack
from functools import cache
from threading import Thread
from typing import Any, TypeVar

import cloudpickle
import joblib
from joblib.externals.loky import ProcessPoolExecutor
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn
from threadpoolctl import threadpool_limits

from pipeline.errors import PipelineError

Item = TypeVar("Item")
Result = TypeVar("Result")


def parallel_map(function: Callable[[Item], Result], items: Iterable[Item], label: str) -> list[Result]:
    """``[function(i) for i in items]`` over processes, in order, with progress under ``label``.

    One process a core here, this one among them; the workers of a Dask cluster where
    ``DASK_SCHEDULER_ADDRESS`` names its scheduler (that needs the package ``distributed``).
    """
    work = list(items)
    address = os.environ.get("DASK_SCHEDULER_ADDRESS")
    with progress_bar() as bar:
        task = bar.add_task(label, total=len(work))

        def advance() -> None:
            bar.advance(task)

        results = _on_cluster(address, function, work, advance) if address else _here(function, work, advance)
    if not bar.console.is_terminal:
        bar.console.print(f"{label}: {len(work)} done")
    return results


def _one_thread(function: Callable[[Item], Result], item: Item) -> Result:
    # Processes that each start a thread per core only fight over the cores.
    with threadpool_limits(1):
        return function(item)


# ---------------------------------------------------------------------- this machine
def _here(function: Callable[[Item], Result], work: list[Item], advance: Callable[[], None]) -> list[Result]:
    """Share the items out between this process and helpers on the other cores, one by one.

    A helper imports for seconds what this process has imported already, and takes its first item
    only then, so that little work is done before nobody needs it.
    """
    left = deque(range(len(work)))
    futures: list[Future[Result]] = [Future() for _ in work]

    def take(run: Callable[[Item], Result]) -> None:
        while True:
            try:
                i = left.popleft()
            except IndexError:
                return
            try:
                futures[i].set_result(run(work[i]))
            except Exception as error:
                left.clear()
                futures[i].set_exception(error)
            advance()

    helpers = min(len(work), os.cpu_count() or 1) - 1
    pool = ProcessPoolExecutor(max(1, helpers))
    # Pickled once: what it computes on first use and keeps (a plant's functions) is then kept for all its items.
    payload = cloudpickle.dumps(function)

    def help_along() -> None:
        try:
            pool.submit(_loaded, payload).result()
        except Exception:
            return  # shut down before it was ready
        take(lambda item: pool.submit(_helped, payload, item).result())

    finished = False
    try:
        for _ in range(helpers):
            Thread(target=help_along, daemon=True).start()
        take(lambda item: _one_thread(function, item))
        ended, _ = wait(futures, return_when=FIRST_EXCEPTION)
        for error in (future.exception() for future in ended):
            if error is not None:
                raise error
        finished = True
    finally:
        if helpers:
            pool.shutdown(kill_workers=not finished)
    return [future.result() for future in futures]


@cache
def _loaded(payload: bytes) -> Callable[[Any], Any]:
    """The function of a payload, in a helper; the first call imports what it needs."""
    return cloudpickle.loads(payload)


def _helped(payload: bytes, item: Any) -> Any:
    return _one_thread(_loaded(payload), item)


# ---------------------------------------------------------------------- a cluster
def _on_cluster(
    address: str, function: Callable[[Item], Result], work: list[Item], advance: Callable[[], None]
) -> list[Result]:
    with ExitStack() as stack:
        stack.enter_context(joblib.parallel_config(backend="dask", client=stack.enter_context(_cluster(address))))
        results = []
        for result in joblib.Parallel(n_jobs=-1, return_as="generator")(
            joblib.delayed(_one_thread)(function, item) for item in work
        ):
            results.append(result)
            advance()
        return results


def _cluster(address: str) -> Any:
    try:
        from distributed import Client
    except ImportError:
        raise PipelineError(
            f"DASK_SCHEDULER_ADDRESS is {address}, which needs the package distributed: "
            "pip install '.[cluster]', or unset it to use this machine's cores"
        ) from None
    return Client(address)


def progress_bar() -> Progress:
    """A progress bar on stderr; silent where stderr is not a terminal."""
    console = Console(stderr=True)
    return Progress(
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        console=console,
        disable=not console.is_terminal,
    )
