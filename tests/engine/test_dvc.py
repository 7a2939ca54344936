"""DVC as the program starts it: its Python, what it depends on, and why it failed."""

from __future__ import annotations

import configparser
import os
import site
import subprocess
import sys
from pathlib import Path

import pytest

from loopwright.pipeline.engine import dvc
from loopwright.pipeline.errors import PipelineError

ROOT = Path(__file__).parents[2]
# DVC itself, which says what its shell finds as `python` and then fails.
FAKE = "import sys; sys.stderr.write({!r}); sys.exit({})"
DOT = """strict digraph {
"fit@a-one";
"fit@a-one" -> "design@a-pid";
"design@a-pid" -> "validate@a-pid";
"fit@a-one" -> "design@a-inc";
"validate@a-pid" -> "report@a";
"fit@b-one" -> "report@b";
"report@a" -> "overview";
}
"""


@pytest.mark.skipif(sys.platform == "win32", reason="links need rights there")
def test_python_is_this_python_even_behind_a_link(tmp_path: Path) -> None:
    """An environment's python is a link to another folder's, which has none of its packages."""
    link = tmp_path / "bin" / "python"
    link.parent.mkdir()
    link.symlink_to(sys.executable)
    asked = "from loopwright.pipeline.engine.dvc import environment; print(environment()['PATH'])"
    # The other folder's Python has no packages of its own.
    bare = {
        **os.environ,
        "PATH": "/usr/bin:/bin",
        "PYTHONPATH": os.pathsep.join([str(ROOT / "tools/roots"), *site.getsitepackages()]),
    }
    done = subprocess.run([link, "-c", asked], env=bare, capture_output=True, text=True, check=True, timeout=60)
    assert done.stdout == f"{link.parent}:/usr/bin:/bin\n"


def test_the_rest_of_the_environment_stays(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("PATH")
    monkeypatch.setenv("MARK", "1")
    assert dvc.environment() == {**os.environ, "PATH": str(Path(sys.executable).parent)}


@pytest.mark.parametrize(
    ("said", "reason"),
    [
        (
            "code: No module named 'grimp'\n\nERROR: failed to reproduce 'code': failed to run: x, exited with 1\n",
            "code: No module named 'grimp'",
        ),
        ("ERROR: Unable to acquire lock\n", "ERROR: Unable to acquire lock"),
        ("", "no output"),
    ],
)
def test_a_failure_is_the_line_that_says_why(said: str, reason: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(dvc, "COMMAND", (sys.executable, "-c", FAKE.format(said, 1)))
    with pytest.raises(PipelineError) as error:
        dvc.ask("repro", "code")
    assert str(error.value) == f"dvc repro failed: {reason}"


def test_commands_in_turn_say_what_each_of_them_says(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """And the one that fails is named, by the real DVC."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("DVC_NO_ANALYTICS", "1")
    assert dvc.ask_in_turn(["init", "--no-scm", "--quiet"], ["root"]) == ["", ".\n"]
    with pytest.raises(PipelineError, match=r"^dvc repro failed: ERROR: .*dvc\.yaml"):
        dvc.ask_in_turn(["root"], ["repro", "fit"], ["root"])


def test_what_depends_on_a_change_is_affected() -> None:
    assert dvc.affected(DOT, ["design@a-pid"]) == ["design@a-pid", "overview", "report@a", "validate@a-pid"]
    assert dvc.affected(DOT, ["fit@a-one", "fit@b-one"], ["design@a-inc", "report@b"]) == [
        *("design@a-inc", "fit@a-one", "fit@b-one", "report@b"),
    ]


def test_a_copy_without_history_needs_no_git(tmp_path: Path) -> None:
    """DVC refuses a folder without git unless it is told; a history that comes later counts again."""
    (tmp_path / ".dvc").mkdir()
    (tmp_path / ".dvc" / "config").write_text("[core]\n    analytics = false\n")
    local = tmp_path / ".dvc" / "config.local"

    def without_git() -> bool:
        read = configparser.ConfigParser()
        read.read(local)
        return read.getboolean("core", "no_scm", fallback=False)

    local.write_text("[core]\n    remote = mine\n")
    dvc.suit_history(tmp_path)
    assert without_git()
    assert "remote = mine" in local.read_text()
    (tmp_path / ".git").mkdir()
    dvc.suit_history(tmp_path)
    assert not without_git()
    dvc.suit_history(tmp_path / "nowhere")  # no folder of DVC: nothing to tell


def test_a_repository_with_history_is_left_alone(tmp_path: Path) -> None:
    (tmp_path / ".dvc").mkdir()
    (tmp_path / ".git").write_text("gitdir: elsewhere")  # as in a work tree
    dvc.suit_history(tmp_path)
    assert not (tmp_path / ".dvc" / "config.local").exists()
