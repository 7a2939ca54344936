"""Independent pieces of one stage, side by side, with a line of progress."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable
from contextlib import ExitStack
from typing import Any, TypeVar

import joblib
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn
from threadpoolctl import threadpool_limits

from pipeline.errors import PipelineError

Item = TypeVar("Item")
Result = TypeVar("Result")


def _one_thread(function: Callable[[Item], Result], item: Item) -> Result:
    # Processes that each start a thread per core only fight over the cores.
    with threadpool_limits(1):
        return function(item)


def parallel_map(function: Callable[[Item], Result], items: Iterable[Item], label: str) -> list[Result]:
    """``[function(i) for i in items]`` over processes, in order, with progress under ``label``.

    One process a core here; the workers of a Dask cluster where ``DASK_SCHEDULER_ADDRESS`` names
    its scheduler (that needs the package ``distributed``).
    """
    work = list(items)
    address = os.environ.get("DASK_SCHEDULER_ADDRESS")
    jobs = max(1, min(len(work), os.cpu_count() or 1))
    with ExitStack() as stack:
        if address:
            stack.enter_context(joblib.parallel_config(backend="dask", client=stack.enter_context(_cluster(address))))
            jobs = -1
        bar = stack.enter_context(progress_bar())
        task = bar.add_task(label, total=len(work))
        results = []
        runner = joblib.Parallel(n_jobs=jobs, return_as="generator")
        for result in runner(joblib.delayed(_one_thread)(function, item) for item in work):
            results.append(result)
            bar.advance(task)
    if not bar.console.is_terminal:
        bar.console.print(f"{label}: {len(work)} done")
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
