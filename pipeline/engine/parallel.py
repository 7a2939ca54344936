"""Independent pieces of one stage, side by side, with a line of progress."""

from __future__ import annotations

import multiprocessing
import os
import pickle
import sys
import traceback
import warnings
from collections import deque
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import FIRST_EXCEPTION, Future, wait
from contextlib import ExitStack
from multiprocessing.connection import Connection
from threading import Thread
from typing import Any, TypeVar

import cloudpickle
import joblib
from threadpoolctl import threadpool_limits

from pipeline.engine.lifeline import end_with_parent
from pipeline.engine.progress import piece, progress_bar, within
from pipeline.errors import PipelineError

Item = TypeVar("Item")
Result = TypeVar("Result")
# A fork has everything imported already, which takes seconds. Elsewhere the system's own libraries do not survive one.
CONTEXT: Any = multiprocessing.get_context("fork" if sys.platform == "linux" else "spawn")


def parallel_map(
    function: Callable[[Item], Result], items: Iterable[Item], label: str, weights: Sequence[float] | None = None
) -> list[Result]:
    """``[function(i) for i in items]`` over processes, in order; ``label`` (``STAGE: WHAT``) names the progress.

    One process a core here, this one among them; the workers of a Dask cluster where
    ``DASK_SCHEDULER_ADDRESS`` names its scheduler (that needs the package ``distributed``). ``weights`` are about
    what the items cost beside each other (None: all the same), for the progress alone.

    Raises whatever ``function`` raises, of the first item that fails, and PipelineError where a
    process dies.
    """
    work = list(items)
    address = os.environ.get("DASK_SCHEDULER_ADDRESS")
    if address:
        return _on_cluster(address, function, work, label)
    return _here(function, work, label, [1.0] * len(work) if weights is None else list(weights))


def _one_thread(function: Callable[[Item], Result], item: Item) -> Result:
    # Processes that each start a thread per core only fight over the cores.
    with threadpool_limits(1):
        return function(item)


# ---------------------------------------------------------------------- this machine
def _here(function: Callable[[Item], Result], work: list[Item], label: str, weights: Sequence[float]) -> list[Result]:
    """Share the items out between this process and helpers on the other cores, one by one."""
    left = deque(range(len(work)))
    futures: list[Future[Result]] = [Future() for _ in work]
    # Before the bar, whose thread could hold a lock that a fork would then never see released.
    # A helper has no helpers: it runs the pieces of a piece by itself.
    cores = 1 if multiprocessing.current_process().daemon else os.cpu_count() or 1
    helpers = [_Helper(function, label) for _ in range(min(len(work), cores) - 1)]
    finished = False
    try:
        # The steps of a single item are what there is to show; those of several would be mixed up.
        with progress_bar() as bar, within(label.partition(": ")[0] if len(work) == 1 and bar.disable else ""):
            task = bar.add_task(label, total=len(work))
            whole = piece(label, sum(weights)) if bar.disable and work[1:] else None
            ended_ones = set[int]()

            def advance(i: int) -> None:
                bar.advance(task)
                ended_ones.add(i)
                if whole is not None:
                    whole.show(sum(weights[k] for k in tuple(ended_ones)), f"{len(ended_ones)} of {len(work)}")

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
                    advance(i)

            for helper in helpers:
                Thread(target=helper.help_along, args=(take,), daemon=True).start()
            take(lambda item: _one_thread(function, item))
            ended, _ = wait(futures, return_when=FIRST_EXCEPTION)
            for error in (future.exception() for future in ended):
                if error is not None:
                    raise error
        finished = True
    finally:
        for helper in reversed(helpers):  # a fork holds the connections of those before it
            helper.end(kill=not finished)
    return [future.result() for future in futures]


class _Helper:
    """A process beside this one that runs item after item; it ends when this one does."""

    def __init__(self, function: Callable[[Any], Any], label: str) -> None:
        self.label, self.ready = label, False
        self.connection, theirs = CONTEXT.Pipe()
        forked = CONTEXT.get_start_method() == "fork"
        # Pickled once: what it computes on first use and keeps (a plant's functions) is then kept for all its items.
        given = (function, self.connection) if forked else (cloudpickle.dumps(function), None)
        self.process = CONTEXT.Process(target=_help, args=(theirs, *given), daemon=True)
        with warnings.catch_warnings():
            # The threads that Python 3.12 warns of are those of the linear algebra, which expects forks.
            warnings.simplefilter("ignore", DeprecationWarning)
            self.process.start()
        theirs.close()

    def help_along(self, take: Callable[[Callable[[Any], Any]], None]) -> None:
        """Have the process run what ``take`` gives, once it is ready: little work may be done before it is."""
        try:
            self.connection.recv()
        except (EOFError, OSError):
            return  # ended before it was ready
        self.ready = True
        take(self.run)

    def run(self, item: Any) -> Any:
        """One item, there; raises what it raises."""
        try:
            self.connection.send(item)
            answer = self.connection.recv_bytes()
        except (EOFError, OSError):
            self.process.join(1)
            raise PipelineError(
                f"{self.label}: a helper process died (exit code {self.process.exitcode}; -9 often means that the "
                "memory was not enough); run it again"
            ) from None
        error, result = pickle.loads(answer)
        if error is not None:
            raise error
        return result

    def end(self, kill: bool) -> None:
        """Wait for the process, which ends where no item comes; or stop it where it is."""
        if kill or not self.ready:
            self.process.kill()
        self.connection.close()
        self.process.join()


def _help(connection: Connection, function: Callable[[Any], Any] | bytes, others: Connection | None) -> None:
    """Run items as they come, in a helper, until the other end is closed."""
    end_with_parent()
    if others is not None:
        others.close()  # this fork's copy, which would keep it from seeing the end
    try:
        work = cloudpickle.loads(function) if isinstance(function, bytes) else function
        connection.send(None)
        while True:
            connection.send_bytes(_answer(work, connection.recv()))
    except (EOFError, OSError, KeyboardInterrupt):
        return


def _answer(function: Callable[[Any], Any], item: Any) -> bytes:
    """The error of an item and its result, one of which is None, pickled."""
    try:
        return pickle.dumps((None, _one_thread(function, item)))
    except Exception as error:
        error.add_note(f"in a helper process:\n{traceback.format_exc()}")
        try:
            answer = pickle.dumps((error, None))
            pickle.loads(answer)
        except Exception:  # not every error survives the way
            return pickle.dumps((PipelineError(f"{type(error).__name__}: {error}"), None))
        return answer


# ---------------------------------------------------------------------- a cluster
def _on_cluster(address: str, function: Callable[[Item], Result], work: list[Item], label: str) -> list[Result]:
    with ExitStack() as stack:
        bar = stack.enter_context(progress_bar())
        stack.enter_context(joblib.parallel_config(backend="dask", client=stack.enter_context(_cluster(address))))
        found = joblib.Parallel(n_jobs=-1, return_as="generator")(
            joblib.delayed(_one_thread)(function, item) for item in work
        )
        return list(bar.track(found, total=len(work), description=label))


def _cluster(address: str) -> Any:
    try:
        from distributed import Client
    except ImportError:
        raise PipelineError(
            f"DASK_SCHEDULER_ADDRESS is {address}, which needs the package distributed: "
            "pip install '.[cluster]', or unset it to use this machine's cores"
        ) from None
    return Client(address)
