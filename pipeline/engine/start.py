"""``python -m loopwright.pipeline.engine.start KIND [NAME]``: one stage, as dvc.yaml runs it.

A stage that works long runs on the cluster that DASK_SCHEDULER_ADDRESS names, which `loopwright run` starts on this
machine; without one it starts its own. This process then only reads, waits and writes. Under DVC a stage that
succeeded leaves a receipt of its start and duration, see ``write_receipt``.

This module imports the standard library alone, because every stage starts with it.
"""

from __future__ import annotations

import gc
import json
import os
import runpy
import signal
import socket
import sys
import threading
import time
from contextlib import suppress
from pathlib import Path

# Set for the commands under loopwright.pipeline.engine.with_cluster: the door of a run, which is open as long as the
# run goes on.
DOOR = "LOOPWRIGHT_RUN"
# New objects before garbage is looked for. A stage imports for a second and ends soon: at Python's 700 a sixth of its
# time goes into looking through libraries that stay.
NEW_OBJECTS = 200_000
STOPPED = 130  # exit status of a stage that was ended with the whole run, as a shell counts Ctrl-C


def receipt_path(root: Path, stage: str) -> Path:
    """Where the receipt of a stage of dvc.yaml lies; no output of a stage, so no result depends on it."""
    return root / "receipts" / f"{stage}.json"


def write_receipt(started: float, seconds: float) -> None:
    """Keep when the stage that DVC runs here started [s since 1970] and how long it took; nothing without DVC."""
    stage, root = os.environ.get("DVC_STAGE"), os.environ.get("DVC_ROOT")
    if not stage or not root:
        return
    path = receipt_path(Path(root), stage)
    draft = path.with_name(path.name + ".draft")
    with suppress(OSError):  # a stage that succeeded does not fail for want of its receipt
        path.parent.mkdir(exist_ok=True)
        draft.write_text(json.dumps({"stage": stage, "started": started, "seconds": round(seconds, 3)}) + "\n")
        os.replace(draft, path)


def end_with_run() -> None:
    """Have this process end when the run that it belongs to ends; STOPPED at once if it has ended already."""
    door = os.environ.get(DOOR)
    if not door:
        return
    line = socket.socket(socket.AF_UNIX)
    try:
        line.connect(door)
    except OSError:
        sys.exit(STOPPED)

    def wait() -> None:
        with suppress(OSError):
            line.recv(1)
        os.kill(os.getpid(), signal.SIGTERM)

    threading.Thread(target=wait, daemon=True).start()


def run_here(arguments: list[str]) -> int | str | None:
    """The stage in this process; what it gives to ``sys.exit``."""
    sys.argv[1:] = arguments[1:]
    try:
        runpy.run_module(f"loopwright.pipeline.stages.{arguments[0]}", run_name="__main__", alter_sys=True)
    except SystemExit as end:
        return end.code
    return 0


def run(arguments: list[str]) -> int | str | None:
    """The stage, on a cluster or here; what ``sys.exit`` is to be given."""
    from loopwright.pipeline.engine.stage_files import on_cluster

    files = on_cluster(arguments[0], arguments[1]) if len(arguments) == 2 else None
    if files is None:
        return run_here(arguments)
    from loopwright.pipeline.engine.cluster import STAGES, address, local_cluster
    from loopwright.pipeline.engine.remote import FAILED, run_on
    from loopwright.pipeline.errors import PipelineError

    try:
        at = address()
        if at is not None:
            return run_on(at, arguments, files)
        os.environ[STAGES] = arguments[0]
        try:
            with local_cluster() as own:
                return run_on(own, arguments, files)
        finally:
            del os.environ[STAGES]
    except PipelineError as error:
        print(f"{' '.join(arguments)}: {error}", file=sys.stderr)
        return FAILED
    except KeyboardInterrupt:
        return STOPPED


def main() -> None:
    """Run the stage that the command line names."""
    arguments = sys.argv[1:]
    if not arguments or not arguments[0].isidentifier():
        sys.exit("usage: python -m loopwright.pipeline.engine.start KIND [NAME]: a stage, as dvc.yaml runs it")
    gc.set_threshold(NEW_OBJECTS)
    end_with_run()
    started, clock = time.time(), time.monotonic()
    code = run(arguments)
    if not code:
        write_receipt(started, time.monotonic() - clock)
    sys.stdout.flush()
    sys.stderr.flush()
    # Nothing is left to do: the connection's threads need not be waited for.
    if isinstance(code, str):
        print(code, file=sys.stderr, flush=True)
    os._exit(code if isinstance(code, int) else int(code is not None))


if __name__ == "__main__":
    main()
