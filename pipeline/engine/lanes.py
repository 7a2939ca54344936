"""``python -m pipeline.engine.lanes [--rest] STAGE,STAGE,... ...``: chains of stages side by side.

DVC runs one stage after another, and in each there is a while in which a core has nothing to do: imports, a single
data seed, DVC's own files. Chains that share no output fill it. Each lane takes the next chain and has a ``dvc repro``
of its own run its stages in their order, up to the first that fails; the stages that they depend on, outside the chain,
must be up to date. With ``--rest`` one more ``dvc repro`` then runs whatever is left. A chain that fails ends the run
once those beside it have ended. Results are those of one lane.

What the lanes write comes line by line to one output, without DVC's lines on stages that it skips.
"""

from __future__ import annotations

import contextlib
import os
import selectors
import signal
import subprocess
import sys
from collections.abc import Sequence

from pipeline.engine.lifeline import end_with_parent

LANES = 2  # more fill no core further: every stage already starts a process a core
REST = "--rest"
SKIPPED = b"didn't change, skipping"


def main(argv: Sequence[str]) -> int:
    """Run the chains, then the rest if asked; the exit status of the first failure, or 0."""
    chains = [a.split(",") for a in argv if a != REST]
    if not chains or any(chain[0].startswith("-") for chain in chains):
        print(
            f"usage: python -m pipeline.engine.lanes [{REST}] STAGE,STAGE,... ...: stages of dvc.yaml", file=sys.stderr
        )
        return 2
    lanes = _Lanes([sys.executable, "-m", "dvc", "--wait-for-lock", "repro"])
    # Single items: a look at a stage that they share would lock it for the others.
    return lanes.run([["--single-item", *chain] for chain in chains]) or (lanes.run([[]]) if REST in argv else 0)


class _Lanes:
    """``command`` with one list of arguments after another, a few at once."""

    def __init__(self, command: list[str]) -> None:
        self.command, self.stopped = command, 0  # the signal that ended the run
        self.running = dict[subprocess.Popen[bytes], bytearray]()  # the line that each has begun
        for asked in (signal.SIGINT, signal.SIGTERM):
            signal.signal(asked, lambda number, _: self._stop(number))

    def run(self, work: list[list[str]]) -> int:
        """Do all of ``work``; the exit status of the first failure, or 0."""
        left, first = list(work), 0
        with selectors.DefaultSelector() as waiting:
            while self.running or (left and not self.stopped and not first):
                while left and len(self.running) < LANES and not self.stopped and not first:
                    process = self._begun(left.pop(0))
                    waiting.register(process.stdout, selectors.EVENT_READ, process)  # type: ignore[arg-type]
                for key, _ in waiting.select():
                    if self._passed_on(key.data):
                        continue
                    waiting.unregister(key.fileobj)
                    code = self._ended(key.data)
                    first = first or code
        return first or (128 + self.stopped if self.stopped else 0)

    def _begun(self, arguments: list[str]) -> subprocess.Popen[bytes]:
        own = os.getpid()
        process = subprocess.Popen(
            [*self.command, *arguments],
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            bufsize=0,
            preexec_fn=lambda: end_with_parent(own),
            start_new_session=True,  # so that its stages can be told with it
        )
        self.running[process] = bytearray()
        return process

    def _passed_on(self, process: subprocess.Popen[bytes]) -> bool:
        """Write the lines that a process has completed; False at their end."""
        assert process.stdout is not None
        found = os.read(process.stdout.fileno(), 65_536)
        begun = self.running[process]
        begun += found
        *lines, rest = bytes(begun).split(b"\n") if found else [bytes(begun), b""]
        begun[:] = rest
        for line in lines:
            if line.strip() and not line.rstrip().endswith(SKIPPED):
                os.write(1, line + b"\n")
        return bool(found)

    def _ended(self, process: subprocess.Popen[bytes]) -> int:
        del self.running[process]
        assert process.stdout is not None
        process.stdout.close()
        code = process.wait()
        return 128 - code if code < 0 else code  # of a signal, as a shell counts

    def _stop(self, number: int) -> None:
        """Tell all that runs: DVC alone would leave its stage, and with it our wait, to its end."""
        self.stopped = number
        for process in self.running:
            with contextlib.suppress(ProcessLookupError):
                os.killpg(process.pid, number)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
