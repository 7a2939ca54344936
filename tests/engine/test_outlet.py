"""What a run's workers write: all of it while it runs, nothing after it was stopped."""

from __future__ import annotations

import subprocess
import sys

PROGRAM = """
import subprocess, sys, threading
from pipeline.engine.outlet import outlet
stopped = threading.Event()
with outlet(stopped):
    subprocess.run([sys.executable, "-c", "import sys; print('from a worker', file=sys.stderr)"])
    if "stop" in sys.argv:
        stopped.set()
    subprocess.run([sys.executable, "-c", "import sys; print('later', file=sys.stderr)"])
print("the last line", file=sys.stderr)
"""


def said(*arguments: str) -> list[str]:
    done = subprocess.run([sys.executable, "-c", PROGRAM, *arguments], capture_output=True, text=True, check=True)
    return done.stderr.splitlines()


def test_all_of_it_comes_in_order() -> None:
    assert said() == ["from a worker", "later", "the last line"]


def test_nothing_comes_of_a_stopped_run() -> None:
    lines = said("stop")
    assert "later" not in lines
    assert lines[-1] == "the last line"
