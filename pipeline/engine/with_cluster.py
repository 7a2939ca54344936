"""``python -m loopwright.pipeline.engine.with_cluster COMMAND...``: run a command whose stages share one cluster.

The cluster has a worker of one thread a core, which loads its libraries once; or it is the one that
DASK_SCHEDULER_ADDRESS names. Stages end with this process, whatever ends it: after SIGTERM those that run are ended,
and those that would begin are refused, so that the command (``dvc repro``) ends by itself.
"""

from __future__ import annotations

import contextlib
import os
import signal
import socket
import subprocess
import sys
import threading
from collections.abc import Iterator, Sequence
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory

from loopwright.pipeline.engine.cluster import address, local_cluster, usual_workers
from loopwright.pipeline.engine.dvc import end_with_parent
from loopwright.pipeline.engine.output import outlet
from loopwright.pipeline.engine.start import DOOR
from loopwright.pipeline.errors import PipelineError


def main(argv: Sequence[str]) -> int:
    """Run the command; its exit status."""
    command = list(argv)
    if not command:
        usage = "usage: python -m loopwright.pipeline.engine.with_cluster COMMAND..., such as: "
        print(usage + "python -m loopwright.pipeline.engine.with_cluster dvc repro", file=sys.stderr)
        return 2
    try:
        workers = None if address() else usual_workers()
    except PipelineError as error:
        print(error, file=sys.stderr)
        return 2
    stopped = threading.Event()
    own, running = os.getpid(), list[subprocess.Popen[bytes]]()
    with contextlib.ExitStack() as stack:
        door = stack.enter_context(_door())

        def stop(*_: object) -> None:
            stopped.set()
            # The command hears of it first, so that it says nothing of the stages that end.
            for process in running:
                process.terminate()
            door.shut()

        signal.signal(signal.SIGTERM, stop)
        terminal = stack.enter_context(outlet(stopped))
        if workers:
            stack.enter_context(local_cluster(workers, say=partial(print, flush=True)))
        process = subprocess.Popen(
            command, stderr=terminal, env={**os.environ, **door.environment}, preexec_fn=lambda: end_with_parent(own)
        )
        running.append(process)
        if stopped.is_set():
            process.terminate()
        code = process.wait()
        door.shut()
    return 128 - code if code < 0 else code  # of a command that a signal ended, as a shell counts


class _Door:
    """A socket that stages stay connected to; as it shuts, they end."""

    def __init__(self, at: Path) -> None:
        self.environment = {DOOR: str(at)}
        self.socket, self.lines = socket.socket(socket.AF_UNIX), list[socket.socket]()
        try:
            self.socket.bind(str(at))
        except OSError:  # a path that is too long for a socket
            self.environment = {}
            return
        self.socket.listen()
        threading.Thread(target=self._let_in, daemon=True).start()

    def _let_in(self) -> None:
        with contextlib.suppress(OSError):
            while True:
                self.lines.append(self.socket.accept()[0])

    def shut(self) -> None:
        with contextlib.suppress(OSError):
            self.socket.shutdown(socket.SHUT_RDWR)
        self.socket.close()
        for line in self.lines:
            line.close()


@contextlib.contextmanager
def _door() -> Iterator[_Door]:
    with TemporaryDirectory(prefix="loopwright-") as folder:
        door = _Door(Path(folder) / "run")
        try:
            yield door
        finally:
            door.shut()


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
