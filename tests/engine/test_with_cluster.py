"""A command and its stages under one door: they end with the run, whatever ends it."""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
from processes import lives, within

from loopwright.pipeline.engine.dvc import hear_no_interrupt

ROOT = Path(__file__).parents[2]
PROBE = """
import json, os, sys
told = {"arguments": sys.argv[1:], "folder": os.getcwd(), "of": os.environ.get("OF")}
print(json.dumps(told))
"""
WAIT = """
import os
from pathlib import Path
from threading import Event
Path("pid").write_text(str(os.getpid()))
Event().wait(60)
"""
FILES = (
    "__init__.py",
    "start.py",
    "with_cluster.py",
    "dvc.py",
    "output.py",
    "cluster.py",
    "stage_files.py",
)

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="elsewhere a process does not end with its parent")


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A pipeline of nothing but the modules under test and a stage ``probe``."""
    root = tmp_path / "loopwright"
    stages, engine = root / "pipeline" / "stages", root / "pipeline" / "engine"
    for room in (stages, engine, root / "serving"):
        room.mkdir(parents=True)
    for name in FILES:
        shutil.copy(ROOT / "pipeline" / "engine" / name, engine / name)
    for name in ("errors.py", "files.py"):
        shutil.copy(ROOT / "pipeline" / name, root / "pipeline" / name)
    shutil.copy(ROOT / "serving" / "errors.py", root / "serving" / "errors.py")
    for room in (root / "pipeline", stages, root / "serving"):
        (room / "__init__.py").touch()
    (stages / "probe.py").write_text(PROBE)
    return tmp_path


def begin(folder: Path, script: str, preexec_fn: Callable[[], None] | None = None) -> subprocess.Popen[str]:
    """A shell script under a door, in a session of its own, as a terminal has it. No stage of it needs a cluster."""
    command = [sys.executable, "-m", "loopwright.pipeline.engine.with_cluster"]
    command += ["bash", "-c", script.replace("python", sys.executable)]
    pipe, environment = subprocess.PIPE, {**os.environ, "DASK_SCHEDULER_ADDRESS": "tcp://127.0.0.1:1"}
    return subprocess.Popen(
        command,
        cwd=folder,
        env=environment,
        stdout=pipe,
        stderr=pipe,
        text=True,
        start_new_session=True,
        preexec_fn=preexec_fn,
    )


def run(folder: Path, script: str) -> tuple[int, str, str]:
    process = begin(folder, script)
    out, err = process.communicate(timeout=60)
    return process.returncode, out, err


def waits(folder: Path, script: str, preexec_fn: Callable[[], None] | None = None) -> tuple[subprocess.Popen[str], int]:
    """A script whose stage waits, and the stage's process."""
    (folder / "loopwright" / "pipeline" / "stages" / "probe.py").write_text(WAIT)
    process = begin(folder, script, preexec_fn)
    assert within(20, lambda: (folder / "pid").exists() and (folder / "pid").read_text() != "")
    return process, int((folder / "pid").read_text())


def test_a_stage_that_is_for_nobody_else_runs_where_it_was_started(folder: Path) -> None:
    code, out, err = run(folder, "OF=mine python -m loopwright.pipeline.engine.start probe one; exit 7")
    assert (code, err) == (7, "")
    assert out == f'{{"arguments": ["one"], "folder": "{folder}", "of": "mine"}}\n'


@pytest.mark.parametrize(
    ("text", "status", "says"),
    [
        ("raise SystemExit(2)", 2, ""),
        ("raise SystemExit('no')", 1, "no"),
        ("raise SystemExit()", 0, ""),
        ("1 / 0", 1, "ZeroDivisionError"),
    ],
)
def test_a_stage_ends_with_its_status(folder: Path, text: str, status: int, says: str) -> None:
    (folder / "loopwright" / "pipeline" / "stages" / "probe.py").write_text(text)
    _, out, err = run(folder, "python -m loopwright.pipeline.engine.start probe; echo $?")
    assert out == f"{status}\n"
    assert says in err


def test_a_run_that_is_killed_takes_everything_with_it(folder: Path) -> None:
    script = "echo $$ > shell; python -m loopwright.pipeline.engine.start probe; exec tail -f /dev/null"
    process, pid = waits(folder, script)
    os.kill(process.pid, signal.SIGKILL)
    started = [pid, int((folder / "shell").read_text())]
    assert within(20, lambda: not any(map(lives, started)))
    process.communicate(timeout=20)


def test_ctrl_c_ends_everything(folder: Path) -> None:
    process, pid = waits(folder, "python -m loopwright.pipeline.engine.start probe")
    os.killpg(process.pid, signal.SIGINT)
    process.communicate(timeout=20)
    assert process.returncode != 0
    assert within(20, lambda: not lives(pid))


def test_a_run_that_is_ended_begins_no_stage(folder: Path) -> None:
    """The command hears of it first; a stage that it starts all the same is refused, and none says a word."""
    stage = "python -m loopwright.pipeline.engine.start probe 2>/dev/null"
    process, pid = waits(folder, f"trap 'echo heard' TERM; {stage}; echo $?; {stage}; echo $?; trap - INT")
    process.terminate()
    out, _ = process.communicate(timeout=20)
    assert out.splitlines() == ["heard", "143", "130"]
    assert not lives(pid)


def test_stages_of_a_run_that_hears_no_ctrl_c_hear_none(folder: Path) -> None:
    hears = "import signal; print(signal.getsignal(signal.SIGINT) == signal.SIG_IGN)"
    (folder / "loopwright" / "pipeline" / "stages" / "probe.py").write_text(hears)
    assert run(folder, "python -m loopwright.pipeline.engine.start probe")[1] == "False\n"
    process = begin(folder, "python -m loopwright.pipeline.engine.start probe", preexec_fn=hear_no_interrupt)
    assert process.communicate(timeout=20)[0] == "True\n"


def test_a_socket_that_cannot_be_made_is_no_error(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    long = folder / ("long" * 30)
    long.mkdir()
    monkeypatch.setenv("TMPDIR", str(long))
    code, out, _ = run(folder, "python -m loopwright.pipeline.engine.start probe; exit 7")
    assert code == 7
    assert "arguments" in out


def test_a_command_that_is_missing_is_one_line(folder: Path) -> None:
    process = subprocess.run(
        [sys.executable, "-m", "loopwright.pipeline.engine.with_cluster"],
        cwd=folder,
        capture_output=True,
        text=True,
        timeout=60,
    )
    assert process.returncode == 2
    assert process.stderr.startswith("usage: python -m loopwright.pipeline.engine.with_cluster COMMAND")


def test_a_number_of_workers_that_is_none_is_one_line(folder: Path) -> None:
    without = {name: value for name, value in os.environ.items() if name != "DASK_SCHEDULER_ADDRESS"}
    command = [sys.executable, "-m", "loopwright.pipeline.engine.with_cluster", "true"]
    asked = {**without, "LOOPWRIGHT_WORKERS": "none"}
    process = subprocess.run(command, cwd=folder, env=asked, capture_output=True, text=True, timeout=60)
    assert process.returncode == 2
    assert process.stderr == "LOOPWRIGHT_WORKERS is 'none'; it takes how many workers a run has here, 1 or more\n"
