"""What a run's workers write: all of it while it runs, nothing after it was stopped."""

from __future__ import annotations

import os
import subprocess
import sys
from select import select

PROGRAM = """
import subprocess, sys, threading
from loopwright.pipeline.engine.output import outlet
stopped = threading.Event()
with outlet(stopped):
    subprocess.run([sys.executable, "-c", "import sys; print('from a worker', file=sys.stderr)"])
    if "stop" in sys.argv:
        stopped.set()
    subprocess.run([sys.executable, "-c", "import sys; print('later', file=sys.stderr)"])
subprocess.run([sys.executable, "-c", "import sys; print('too late', file=sys.stderr)"])
print("the last line")
"""


def said(*arguments: str) -> list[str]:
    command, both = [sys.executable, "-c", PROGRAM, *arguments], subprocess.STDOUT
    done = subprocess.run(command, stdout=subprocess.PIPE, stderr=both, text=True, check=True)
    return done.stdout.splitlines()


def test_all_of_it_comes_in_order() -> None:
    assert said() == ["from a worker", "later", "too late", "the last line"]


def test_nothing_comes_of_a_stopped_run() -> None:
    lines = said("stop")
    assert lines[-1] == "the last line"
    assert not {"later", "too late"} & set(lines)


MANY = """
import subprocess, sys, threading
from loopwright.pipeline.engine.output import outlet
with outlet(threading.Event()):
    subprocess.run([sys.executable, "-c", "import os; [os.write(2, b'0123456789' * 1000) for _ in range(50)]"])
print("done", flush=True)
"""


def test_workers_go_on_where_nobody_reads() -> None:
    """Half a megabyte, more than a pipe holds, to a terminal that was closed."""
    source, into = os.pipe()
    os.close(source)
    done = subprocess.run([sys.executable, "-c", MANY], stdout=subprocess.PIPE, stderr=into, text=True, timeout=60)
    os.close(into)
    assert done.stdout == "done\n"


def test_a_byte_of_zero_ends_nothing() -> None:
    many = MANY.replace("0123456789", "abc\\\\0")
    done = subprocess.run([sys.executable, "-c", many], capture_output=True, timeout=60)
    assert done.stderr == b"abc\0" * 50_000


TORN = """
import os, threading
from loopwright.pipeline.engine.output import outlet
os.urandom = lambda n: b"\\n" * n
with outlet(stopped := threading.Event()):
    os.write(2, {text!r})
    while os.read(0, 1) != b"!":
        pass
    stopped.set()
    os.write(2, b"\\nmore\\n")
"""


def stopped_behind(text: bytes) -> tuple[bytes, bytes]:
    """What comes out of a text before the run is stopped behind it, and after that."""
    command = [sys.executable, "-c", TORN.format(text=text)]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stderr=subprocess.PIPE) as running:
        assert running.stdin is not None
        assert running.stderr is not None
        heard = select([running.stderr], [], [], 60)[0] and os.read(running.stderr.fileno(), 100)
        running.stdin.write(b"!")
        running.stdin.close()
        return heard or b"", running.stderr.read()


def test_a_line_waits_for_no_other() -> None:
    """However the mark of the end was drawn: a line that looks like its beginning came before the run was stopped."""
    assert stopped_behind(b"before\n") == (b"before\n", b"")


def test_a_line_that_a_stop_cuts_ends_there() -> None:
    """What is said next begins a line of its own."""
    assert stopped_behind(b"before") == (b"before", b"\n")
