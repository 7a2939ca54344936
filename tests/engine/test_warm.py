"""Stages as forks of a warm process: the same as by themselves, whatever happens to either."""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
from processes import lives, within

from pipeline.engine.lifeline import hear_no_interrupt

SOURCES = Path(__file__).parents[2] / "pipeline"
PROBE = """
import json, os, sys
from pathlib import Path
told = {"arguments": sys.argv[1:], "parent": os.getppid(), "folder": os.getcwd(), "of": os.environ.get("OF")}
print(json.dumps(told))
"""
WAIT = """
import os
from pathlib import Path
from threading import Event
Path("pid").write_text(str(os.getpid()))
Event().wait(60)
"""
# The libraries are no part of these tests.
SERVER = "import sys; from pipeline.engine import warm; warm.LIBRARIES = (); sys.exit(warm.main(sys.argv[1:]))"

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="elsewhere stages start by themselves")


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A pipeline of nothing but the modules under test and a stage ``probe``."""
    stages = tmp_path / "pipeline" / "stages"
    for room in (stages, tmp_path / "pipeline" / "engine"):
        room.mkdir(parents=True)
        (room / "__init__.py").touch()
    (tmp_path / "pipeline" / "__init__.py").touch()
    for name in ("start.py", "warm.py", "lifeline.py"):
        shutil.copy(SOURCES / "engine" / name, tmp_path / "pipeline" / "engine" / name)
    (stages / "probe.py").write_text(PROBE)
    return tmp_path


def begin(folder: Path, script: str, preexec_fn: Callable[[], None] | None = None) -> subprocess.Popen[str]:
    """A shell script under a warm process, in a session of its own, as a terminal has it."""
    command = [sys.executable, "-c", SERVER, "bash", "-c", script.replace("python", sys.executable)]
    pipe = subprocess.PIPE
    return subprocess.Popen(
        command, cwd=folder, stdout=pipe, stderr=pipe, text=True, start_new_session=True, preexec_fn=preexec_fn
    )


def run(folder: Path, script: str) -> tuple[int, str, str]:
    process = begin(folder, script)
    out, err = process.communicate(timeout=60)
    return process.returncode, out, err


def test_a_stage_is_a_fork_of_the_warm_process(folder: Path) -> None:
    code, out, err = run(folder, "echo $PPID; OF=mine python -m pipeline.engine.start probe one; exit 7")
    server, told = out.splitlines()
    assert (code, err) == (7, "")
    assert f'"parent": {server},' in told
    assert '"arguments": ["one"]' in told
    assert f'"folder": "{folder}"' in told
    assert '"of": "mine"' in told


def test_stages_run_the_sources_as_they_are(folder: Path) -> None:
    edit = "echo 'print(\"edited\")' > pipeline/stages/probe.py"
    code, out, _ = run(folder, f"python -m pipeline.engine.start probe; {edit}; python -m pipeline.engine.start probe")
    assert code == 0
    assert out.splitlines()[1] == "edited"


@pytest.mark.parametrize(
    ("text", "status", "says"),
    [
        ("raise SystemExit(2)", 2, ""),
        ("raise SystemExit('no')", 1, "no"),
        ("raise SystemExit()", 0, ""),
        ("1 / 0", 1, "ZeroDivisionError"),
        ("import os; os._exit(3)", 3, ""),
        ("import os; os.kill(os.getpid(), 9)", 137, "stage probe was ended by signal 9"),
    ],
)
def test_a_stage_ends_with_its_status(folder: Path, text: str, status: int, says: str) -> None:
    (folder / "pipeline" / "stages" / "probe.py").write_text(text)
    assert run(folder, "python -m pipeline.engine.start probe; echo $?")[1] == f"{status}\n"
    assert says in run(folder, "python -m pipeline.engine.start probe")[2]


@pytest.mark.parametrize("how", ["cd pipeline; export PYTHONPATH=..", "export LOOPWRIGHT_WARM=nonsense"])
def test_without_a_warm_process_a_stage_starts_by_itself(folder: Path, how: str) -> None:
    process = begin(folder, f"echo $LOOPWRIGHT_WARM; {how}; echo $$; python -m pipeline.engine.start probe 2>&1")
    out, _ = process.communicate(timeout=60)
    warm, shell, told = out.splitlines()
    assert f'"parent": {shell},' in told
    shutil.rmtree(Path(json.loads(warm)[0]).parent, ignore_errors=True)  # which a killed process left


def test_a_stage_that_nobody_waits_for_ends(folder: Path) -> None:
    (folder / "pipeline" / "stages" / "probe.py").write_text(WAIT)
    process = begin(
        folder,
        "python -m pipeline.engine.start probe & while [ ! -s pid ]; do sleep 0.05; done; kill -9 $!; "
        "exec tail -f /dev/null",
    )
    assert within(20, lambda: (folder / "pid").exists() and (folder / "pid").read_text() != "")
    assert within(20, lambda: not lives(int((folder / "pid").read_text())))
    process.terminate()
    _, told = process.communicate(timeout=20)
    # The command's own status, as a shell counts.
    assert process.returncode == 128 + signal.SIGTERM, told


def test_a_warm_process_that_is_killed_takes_everything_with_it(folder: Path) -> None:
    (folder / "pipeline" / "stages" / "probe.py").write_text(WAIT)
    process = begin(folder, "echo $$ > shell; python -m pipeline.engine.start probe; exec tail -f /dev/null")
    assert within(20, lambda: (folder / "pid").exists() and (folder / "pid").read_text() != "")
    os.kill(process.pid, signal.SIGKILL)
    started = [int((folder / name).read_text()) for name in ("pid", "shell")]
    assert within(20, lambda: not any(map(lives, started)))
    process.communicate(timeout=20)


def test_ctrl_c_ends_everything(folder: Path) -> None:
    (folder / "pipeline" / "stages" / "probe.py").write_text(WAIT)
    process = begin(folder, "python -m pipeline.engine.start probe")
    assert within(20, lambda: (folder / "pid").exists() and (folder / "pid").read_text() != "")
    os.killpg(process.pid, signal.SIGINT)
    process.communicate(timeout=20)
    assert process.returncode != 0
    assert not lives(int((folder / "pid").read_text()))


def test_a_run_that_is_ended_begins_no_stage(folder: Path) -> None:
    """The command hears of it first; a stage that it starts all the same is refused, and none says a word."""
    (folder / "pipeline" / "stages" / "probe.py").write_text(WAIT)
    stage = "python -m pipeline.engine.start probe"
    process = begin(folder, f"trap 'echo heard' TERM; {stage}; echo $?; {stage}; echo $?; trap - INT")
    assert within(20, lambda: (folder / "pid").exists() and (folder / "pid").read_text() != "")
    process.terminate()
    out, err = process.communicate(timeout=20)
    assert (out.splitlines(), err) == (["heard", "130", "130"], "")
    assert not lives(int((folder / "pid").read_text()))


def test_stages_of_a_command_that_hears_no_ctrl_c_hear_none(folder: Path) -> None:
    hears = "import signal; print(signal.getsignal(signal.SIGINT) == signal.SIG_IGN)"
    (folder / "pipeline" / "stages" / "probe.py").write_text(hears)
    assert run(folder, "python -m pipeline.engine.start probe")[1] == "False\n"
    process = begin(folder, "python -m pipeline.engine.start probe", preexec_fn=hear_no_interrupt)
    assert process.communicate(timeout=20)[0] == "True\n"


def test_a_socket_that_cannot_be_made_is_no_error(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    long = folder / ("long" * 30)
    long.mkdir()
    monkeypatch.setenv("TMPDIR", str(long))
    code, out, _ = run(folder, "python -m pipeline.engine.start probe; exit 7")
    assert code == 7
    assert "arguments" in out


def test_a_command_that_is_missing_is_one_line(folder: Path) -> None:
    process = subprocess.run(
        [sys.executable, "-m", "pipeline.engine.warm"], cwd=folder, capture_output=True, text=True, timeout=60
    )
    assert process.returncode == 2
    assert process.stderr.startswith("usage: python -m pipeline.engine.warm COMMAND")
