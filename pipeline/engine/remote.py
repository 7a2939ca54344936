"""A stage on a worker: files in, files out.

The client reads what the stage reads and writes what it wrote; in between it only waits, so that it needs no library
of the pipeline. A stage that fails leaves the client's files as they were.
"""

from __future__ import annotations

import importlib
import os
import pickle
import sys
import traceback
import uuid
from collections.abc import Mapping, Sequence
from typing import Any

from loopwright.pipeline.engine.cluster import connected, unwatched
from loopwright.pipeline.engine.fingerprint import commit, difference, fingerprint, told
from loopwright.pipeline.engine.output import BARS
from loopwright.pipeline.engine.stage_files import NewFolder, StageFiles, apply, read_files

FAILED = 2  # exit status of a stage that was lost or that its worker refused; stderr says why


def run_on(at: str, arguments: Sequence[str], files: StageFiles) -> int:
    """Run a stage on the cluster at an address; its exit status. Its output is printed here, line by line."""
    client, topic = connected(at), f"stage-{uuid.uuid4().hex[:12]}"
    # Outputs of a run before are no inputs: DVC removes them, by hand they may be there.
    read = read_files(files.reads)

    def say(event: tuple[float, Any]) -> None:
        stream, text = event[1]
        print(text, end="", file=getattr(sys, stream), flush=True)

    client.subscribe_topic(topic, say)
    ours, bars = dict(fingerprint()), bool(os.environ.get(BARS))
    future = client.submit(
        _run, list(arguments), pickle.dumps(read), ours, topic, commit(), bars, key=topic, pure=False, retries=1
    )
    try:
        answer = future.result()
    except KeyboardInterrupt:
        future.cancel()
        raise
    except Exception as error:
        from loopwright.pipeline.engine.pieces import lost  # with what the pieces need, which a client does not

        print(f"{' '.join(arguments)}: {lost(error, 'the stage')}", file=sys.stderr)
        return FAILED
    code, changes, said = pickle.loads(answer)
    client.unsubscribe_topic(topic)
    for stream, text in said:
        print(text, end="", file=getattr(sys, stream), flush=True)
    if not code:
        apply(changes, anew=files.writes)
    return int(code)


def _run(arguments: list[str], read: bytes, theirs: Mapping[str, str], topic: str, of: str, bars: bool) -> bytes:
    """(exit status, changed files, what was said last), pickled; on a worker."""
    from distributed import get_worker

    from loopwright.pipeline.engine.command import run_stage
    from loopwright.pipeline.engine.output import spoken_to
    from loopwright.pipeline.engine.pieces import WorkerTask, doing, mixture, still_wanted
    from loopwright.pipeline.engine.progress import lines_anew

    worker, files = get_worker(), pickle.loads(read)
    unwatched(worker)
    kind, *names = arguments
    said = list[tuple[str, str]]()

    def say(stream: str, text: str) -> None:
        worker.log_event(topic, (stream, text))

    with spoken_to(say), told(of), lines_anew(marked=bars):
        if other := difference(theirs, fingerprint()):
            return pickle.dumps((FAILED, {}, [("stderr", f"{' '.join(arguments)}: {mixture(other)}\n")]))
        with (
            NewFolder(files, worker.local_directory) as folder,
            doing(WorkerTask(files, lambda: still_wanted(worker, topic))),
        ):
            try:
                stage = getattr(importlib.import_module(f"loopwright.pipeline.stages.{kind}"), kind)
                code = run_stage(stage, [kind, *names], "NAME" if names else "")
            except Exception:
                return pickle.dumps((1, {}, [("stderr", traceback.format_exc())]))
            return pickle.dumps((code, folder.changes(), said))
