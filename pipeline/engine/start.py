"""``python -m pipeline.engine.start KIND [NAME]``: one stage in a process of its own, as dvc.yaml runs them.

The same as ``python -m pipeline.stages.KIND [NAME]``, without seconds of imports where
``python -m pipeline.engine.warm`` runs around it: the stage is then a fork of that process. This module
imports the standard library alone, because every stage starts with it.

Under DVC a stage that succeeded leaves a receipt of its start and duration, see ``write_receipt``.
"""

from __future__ import annotations

import json
import os
import runpy
import socket
import sys
import time
from contextlib import suppress
from pathlib import Path

# Set for the commands under pipeline.engine.warm: its socket, and the installation and folder that it serves.
VARIABLE = "LOOPWRIGHT_WARM"
DIED = 70


def served() -> list[str]:
    """Environment and folder, which a warm process must share with this one to stand in for it."""
    return [sys.prefix, os.getcwd()]


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


def run_warm(arguments: list[str]) -> int | None:
    """The exit status of the stage, run by the warm process; None where there is none, and nothing was run."""
    try:
        address, *of = json.loads(os.environ.get(VARIABLE, ""))
        if of != served():
            return None
        line = socket.socket(socket.AF_UNIX)
        line.connect(address)
    except (OSError, ValueError):
        return None
    with line:
        request = json.dumps({"arguments": arguments, "environment": dict(os.environ)}).encode() + b"\n"
        socket.send_fds(line, [b" "], [0, 1, 2])
        line.sendall(request)
        with line.makefile() as reader:
            answer = reader.readline()
    if not answer:
        print(f"stage {' '.join(arguments)}: the process that ran it died; run it again", file=sys.stderr)
        return DIED
    code = int(answer)
    if code < 0:
        print(f"stage {' '.join(arguments)} was ended by signal {-code}", file=sys.stderr)
        return 128 - code
    return code


def run_here(arguments: list[str]) -> None:
    """The stage in this process; ends with SystemExit, as the stage does."""
    kind = arguments[0]
    sys.argv[1:] = arguments[1:]
    runpy.run_module(f"pipeline.stages.{kind}", run_name="__main__", alter_sys=True)


def run(arguments: list[str]) -> int | str | None:
    """Run the stage, warm or here; returns what ``sys.exit`` is to be given."""
    code = run_warm(arguments)
    if code is not None:
        return code
    try:
        run_here(arguments)
    except SystemExit as end:
        return end.code
    return 0


def main() -> None:
    """Run the stage that the command line names."""
    arguments = sys.argv[1:]
    if not arguments or not arguments[0].isidentifier():
        sys.exit("usage: python -m pipeline.engine.start KIND [NAME]: a stage, as dvc.yaml runs it")
    started, clock = time.time(), time.monotonic()
    code = run(arguments)
    if not code:
        write_receipt(started, time.monotonic() - clock)
    sys.exit(code)


if __name__ == "__main__":
    main()
