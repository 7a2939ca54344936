"""A run of the pipeline is seen by others in its folder for as long as it lasts, whatever ends it."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from loopwright.pipeline.cases.own_model import to_train
from loopwright.pipeline.engine.run_mark import MARK_FILE, run_marked, runs_here

RUN = "from loopwright.pipeline.engine.run_mark import run_marked\nwith run_marked(): print('on', flush=True); input()"


@pytest.fixture(autouse=True)
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)


def test_before_and_after_a_run_nothing_is_under_way() -> None:
    assert not runs_here()
    assert not MARK_FILE.exists()
    with run_marked():
        assert runs_here()
        with run_marked():
            pass
        assert runs_here()  # the other one still is
    assert not runs_here()
    assert not Path("work").exists()  # there is only what stages make: a clone that pulls has the same files


def test_a_run_that_is_killed_is_no_longer_under_way() -> None:
    with subprocess.Popen([sys.executable, "-c", RUN], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as run:
        assert run.stdout is not None
        assert run.stdout.readline() == "on\n"
        assert runs_here()
        run.kill()
        run.wait()
        assert not runs_here()


def test_what_a_person_does_without_models_depends_on_a_run() -> None:
    first = to_train("tank")
    with run_marked():
        during = to_train("tank")
    assert "under way" in during
    assert "`fit tank-identified`" in during
    assert "under way" not in first
    assert all("`loopwright run tank`" in words for words in (first, during))
