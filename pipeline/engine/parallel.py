"""Independent pieces of one stage, side by side on the engine's workers, with progress.

Pieces are values in and bytes out. The result depends neither on which worker does one nor on how many there are.
"""

from __future__ import annotations

import os
import pickle
import uuid
from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import TYPE_CHECKING, Any, TypeVar

import cloudpickle

from loopwright.pipeline.engine.cluster import address, connected
from loopwright.pipeline.engine.fingerprint import fingerprint
from loopwright.pipeline.engine.pieces import WorkerTask, alone, current_task, lost, on_worker
from loopwright.pipeline.engine.progress import piece, progress_bar, within
from loopwright.pipeline.engine.stage_files import Changes, Files, apply
from loopwright.pipeline.errors import PipelineError

if TYPE_CHECKING:
    from distributed import Client

Item = TypeVar("Item")
Result = TypeVar("Result")
SCHEDULER_BATCH = 500  # pieces that the scheduler is told of at a time
RETRIES = 2  # of a piece whose worker was lost
LARGE_FUNCTION = 50_000  # bytes of a function, from which on it is sent once and not with every piece


def parallel_map(
    function: Callable[[Item], Result],
    items: Iterable[Item],
    label: str,
    weights: Sequence[float] | None = None,
    *,
    in_folder: bool = False,
) -> list[Result]:
    """``[function(i) for i in items]`` on the cluster's workers, in order; here where there is no cluster.

    ``label`` (``STAGE: WHAT``) names the progress. ``weights`` are about what the items cost beside each other (None:
    all the same), for the progress alone. With ``in_folder`` a piece finds the stage's files in its working folder,
    and what it writes there is written here.

    Raises whatever ``function`` raises, of the first item that fails, and PipelineError where a worker is lost again
    and again or runs other code.
    """
    work = list(items)
    found: dict[int, Result] = {}
    shares = [1.0] * len(work) if weights is None else list(weights)
    # The steps of a single item are what there is to show; those of several would be mixed up.
    with progress_bar() as bar, within(label.partition(": ")[0] if len(work) == 1 and bar.disable else ""):
        task = bar.add_task(label, total=len(work))
        whole = piece(label, sum(shares)) if bar.disable and work[1:] else None
        ended = set[int]()

        def show(i: int) -> None:
            ended.add(i)
            bar.advance(task)
            if whole is not None:
                whole.show(sum(shares[k] for k in ended), f"{len(ended)} of {len(work)}")

        found.update(as_done(function, work, in_folder=in_folder, show=show))
    return [found[i] for i in range(len(work))]


def as_done(
    function: Callable[[Item], Result],
    items: Iterable[Item],
    *,
    in_folder: bool = False,
    show: Callable[[int], object] = lambda _: None,
) -> Iterator[tuple[int, Result]]:
    """(place, result) of each item, see ``parallel_map``; ``show`` is told the place of each as it ends.

    A client has each result as it ends; a task on a worker has them once all have ended.
    """
    work, task, at = list(items), current_task(), address()
    # Outside a stage nobody has said which files a piece reads: it finds them where this process is.
    if len(work) < 2 or (task is None and (at is None or in_folder)):
        for i, item in enumerate(work):
            yield i, alone(function, item)
            show(i)
        return
    if task is None:
        assert at is not None
        for i, (result, changes) in _answers(connected(at), function, work, None):
            apply(changes)
            show(i)
            yield i, result
        return
    from distributed import worker_client

    answers = dict[int, tuple[Any, Changes]]()
    # While this thread waits, other tasks run in its process, and change its working folder.
    here = os.getcwd()
    try:
        with worker_client() as client:
            for i, ended in _answers(client, function, work, task.files if in_folder else None, task):
                answers[i] = ended
                show(i)
    finally:
        os.chdir(here)
    for i in sorted(answers):
        result, changes = answers[i]
        apply(changes)
        yield i, result


def _answers(
    client: Client, function: Callable[[Any], Any], work: list[Any], files: Files | None, task: WorkerTask | None = None
) -> Iterator[tuple[int, tuple[Any, Changes]]]:
    """(place, (result, changed files)) of each item as it ends; raises what the first to fail raised."""
    from distributed import as_completed

    shared: Any = cloudpickle.dumps((function, files))
    if len(shared) > LARGE_FUNCTION:
        # A client's data on one worker alone would be lost with it; a stage's are on its own worker, and lost with it.
        shared = client.scatter(shared, hash=False, broadcast=task is None)
    name, depth = f"piece-{uuid.uuid4().hex[:12]}", task.depth + 1 if task else 0
    keys = [f"{name}-{i}" for i in range(len(work))]
    # Pieces of pieces come first: who waits for them holds memory.
    options = {"key": keys, "pure": False, "retries": RETRIES, "priority": depth, "batch_size": SCHEDULER_BATCH}
    given = {"shared": shared, "theirs": dict(fingerprint()), "depth": depth}
    futures = client.map(on_worker, [cloudpickle.dumps(item) for item in work], keys, **options, **given)
    places = {key: i for i, key in enumerate(keys)}
    try:
        for future, ended in as_completed(futures, loop=client.loop, with_results=True, raise_errors=False):
            if task is not None and not task.wanted():
                raise PipelineError("nobody waits for this any more")
            place = places[future.key]
            # Not by its status: a result may have come a moment before the worker that kept it was lost.
            if not isinstance(ended, bytes):
                # Of a piece that was given up with the connection Dask has the error alone.
                raise lost(ended if isinstance(ended, Exception) else ended[1], f"piece {place + 1} of {len(work)}")
            failed, result, changes = pickle.loads(ended)
            if failed is not None:
                raise failed
            yield place, (result, changes)
    finally:
        # All clients hear of a cancellation, also of none; Dask takes it amiss as the first word to one that connects.
        if waiting := [f for f in futures if not f.done()]:
            client.cancel(waiting)
