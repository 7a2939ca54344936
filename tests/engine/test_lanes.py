"""Chains of stages side by side: two at once, each in its order, with their failures."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path

import pytest
from processes import lives, within

from loopwright.pipeline.engine.start import DOOR

ROOT = Path(__file__).parents[2]
# In place of DVC: says what it was asked, then what the name of its last stage tells it to do.
DVC = """
import os, signal, sys, time
from pathlib import Path
asked = [a for a in sys.argv[1:] if not a.startswith("-")][1:]
last = asked[-1] if asked else ""
if last == "unheard":  # what is written from here on is not read until the lanes go on
    os.kill(os.getppid(), signal.SIGSTOP)
with open("asked", "a") as file:
    print(*sys.argv[1:], file=file)
print("Stage 'code' didn't change, skipping", flush=True)
print("ran", *asked, flush=True)
print("Running stage 'fit@x':", flush=True)
if last.startswith("meets-"):
    Path(last).touch()
    other = Path("meets-b" if last == "meets-a" else "meets-a")
    end = time.monotonic() + 30
    while not other.exists():
        if time.monotonic() > end:
            sys.exit("alone")
        time.sleep(0.01)
if last in ("waits", "unheard"):
    import subprocess
    stage = subprocess.Popen([sys.executable, "-c", "import time; time.sleep(60)"])  # holds the output open
    Path("pid").write_text(str(stage.pid))
    stage.wait()
    if last == "unheard":
        import fcntl, termios
        while any(fcntl.ioctl(1, termios.FIONREAD, bytes(4))):
            time.sleep(0.01)
    Path("written").touch()  # as dvc.lock would be
    print("ERROR: failed to reproduce 'fit@x'", flush=True)
    while "--keep-going" in sys.argv:
        time.sleep(0.01)
sys.exit(3 if last.startswith("fails") else 0)
"""


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    (tmp_path / "dvc").mkdir()
    (tmp_path / "dvc" / "__init__.py").touch()
    (tmp_path / "dvc" / "__main__.py").write_text(DVC)
    return tmp_path


def begin(folder: Path, *arguments: str) -> subprocess.Popen[str]:
    environment: Mapping[str, str] = {**os.environ, "PYTHONPATH": f"{folder}{os.pathsep}{ROOT}/tools/roots"}
    pipe = subprocess.PIPE
    command = [sys.executable, "-m", "loopwright.pipeline.engine.parallel_dvc", *arguments]
    return subprocess.Popen(command, cwd=folder, env=environment, stdout=pipe, stderr=pipe, text=True)


def run(folder: Path, *arguments: str) -> tuple[int, list[str], list[str]]:
    process = begin(folder, *arguments)
    out, _ = process.communicate(timeout=60)
    asked = folder / "asked"
    return process.returncode, out.splitlines(), asked.read_text().splitlines() if asked.exists() else []


def test_two_chains_run_at_once_and_the_rest_after_them(folder: Path) -> None:
    code, out, asked = run(folder, "--rest", "fit@a,meets-a", "fit@b,meets-b", "fit@c")
    assert code == 0
    assert asked[-1] == "--wait-for-lock repro"
    assert sorted(asked[:2]) == [f"--wait-for-lock repro --single-item fit@{x} meets-{x}" for x in "ab"]
    own = sorted(line for line in out if not line.startswith("stage"))
    assert own == ["ran", "ran fit@a meets-a", "ran fit@b meets-b", "ran fit@c"]
    assert [line for line in out if line.startswith("stage")] == [f"stage {k} of {k}: fit x" for k in (1, 2, 3, 4)]


def test_one_repro_takes_its_own_options(folder: Path) -> None:
    code, out, asked = run(folder, "--of", "fit@x,fit@y", "repro", "--keep-going", "fit@c")
    assert (code, asked) == (0, ["repro --keep-going fit@c"])
    assert out == ["ran fit@c", "stage 1 of 2: fit x"]


def test_a_failure_begins_no_further_chain(folder: Path) -> None:
    code, out, _ = run(folder, "--rest", "fails-a", "fails-b", "fit@c")
    assert code == 3
    assert "ran fit@c" not in out
    assert "ran" not in out


def test_without_chains_it_says_how_it_is_used(folder: Path) -> None:
    assert run(folder)[0] == 2
    assert run(folder, "--keep-going", "fit@a")[0] == 2


@pytest.mark.skipif(sys.platform == "win32", reason="no such signals")
@pytest.mark.parametrize("asked", [signal.SIGTERM, signal.SIGINT])
def test_lanes_that_are_ended_end_the_stages_that_run(folder: Path, asked: signal.Signals) -> None:
    process = begin(folder, "waits", "fit@b")
    pid = folder / "pid"
    assert within(30, lambda: pid.exists() and bool(pid.read_text()))
    process.send_signal(asked)
    process.communicate(timeout=30)
    assert process.returncode == 128 + asked
    assert within(5, lambda: not lives(int(pid.read_text())))


@pytest.mark.skipif(sys.platform == "win32", reason="no such signals")
@pytest.mark.parametrize("further", [[], ["--keep-going"]])
@pytest.mark.parametrize(("stage", "lines"), [("waits", ["ran waits", "stage 1 of 1: fit x"]), ("unheard", [])])
def test_dvc_ends_by_itself_where_its_stage_is_ended(
    folder: Path, further: list[str], stage: str, lines: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """A signal in the middle of writing dvc.lock would cost the finished stages; what it then says is of no use.

    So it is where the lanes had no time to read, before the signal, that the stage had begun.
    """
    monkeypatch.setenv(DOOR, "which shuts, so that stages end")
    process = begin(folder, "repro", *further, stage)
    assert process.stdout is not None
    told = [process.stdout.readline().rstrip() for _ in lines]
    pid = folder / "pid"
    assert within(30, lambda: pid.exists() and bool(pid.read_text()))
    process.send_signal(signal.SIGTERM)
    os.kill(int(pid.read_text()), signal.SIGTERM)  # as the shutting door does
    process.send_signal(signal.SIGCONT)
    out, err = process.communicate(timeout=60)
    assert process.returncode == 128 + signal.SIGTERM
    assert (told, out, err) == (lines, "", "")
    assert (folder / "written").exists()
