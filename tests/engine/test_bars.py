"""Bars of a run on a terminal, drawn from the marked lines that stages write."""

from __future__ import annotations

import io
import json
import os
import pty
import subprocess
import sys
from pathlib import Path

import pytest
from rich.console import Console

from loopwright.pipeline.engine.output import BARS, MARK
from loopwright.pipeline.engine.parallel_dvc import Bars
from loopwright.pipeline.engine.progress import Lines, WorkPiece


def drawn(terminal: bool) -> tuple[Bars, io.StringIO]:
    out = io.StringIO()
    return Bars(Console(file=out, force_terminal=terminal, width=100)), out


def test_a_marked_line_moves_the_bar_of_its_stage_and_no_text_is_lost(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(BARS, "1")
    now = [0.0]
    out = io.StringIO()
    monkeypatch.setattr(sys, "stderr", out)
    piece = WorkPiece("fit a: networks", 10.0, Lines(lambda: now[0]))
    for at, done in ((0.2, 1), (20.0, 4), (20.1, 5), (40.0, 8)):
        now[0] = at
        piece.show(done, "of no use here")
    marked = out.getvalue().splitlines()
    told = [json.loads(line.removeprefix(MARK)) for line in marked]
    assert told == [
        {"label": "fit a: networks", "share": 0.4, "left": "about 30 s left"},
        {"label": "fit a: networks", "share": 0.8, "left": "about 10 s left"},
    ]
    bars, shown = drawn(terminal=True)
    with bars:
        assert all(bars.takes(1, line) for line in marked)
        assert not bars.takes(1, "fit a: 3 samples [left] out")
        bars.write("fit a: 3 samples [left] out")
        assert "about 10 s left" in shown.getvalue()
        bars.ended(1)
    assert "fit a: 3 samples [left] out\n" in shown.getvalue()


def test_bars_are_drawn_on_a_terminal_alone() -> None:
    assert drawn(terminal=True)[0].shown
    assert not drawn(terminal=False)[0].shown


def test_lanes_draw_a_bar_on_a_real_terminal_and_leave_lines_alone(tmp_path: Path) -> None:
    """A stand-in for DVC says what a stage says."""
    told = json.dumps({"label": "fit a: networks", "share": 0.5, "left": ""})
    (tmp_path / "dvc.py").write_text(f"""
import os, sys
print("Running stage 'fit@a':", flush=True)
bars = os.environ.get({BARS!r})
print({MARK + told!r} if bars else "fit a: networks: 50 % done", file=sys.stderr, flush=True)
print("fit a: done", flush=True)
""")
    command = [sys.executable, "-m", "loopwright.pipeline.engine.parallel_dvc", "--of", "fit@a", "repro"]
    environment = {
        **os.environ,
        "PYTHONPATH": f"{tmp_path}{os.pathsep}{Path(__file__).parents[2]}/tools/roots",
        "TERM": "xterm",
    }
    plain = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True, timeout=60)
    assert plain.stdout.splitlines() == ["stage 1 of 1: fit a", "fit a: networks: 50 % done", "fit a: done"]
    ours, theirs = pty.openpty()
    process = subprocess.Popen(command, cwd=tmp_path, env=environment, stdout=theirs, stderr=theirs)
    os.close(theirs)
    seen = b""
    while chunk := _read(ours):
        seen += chunk
    assert process.wait(timeout=60) == 0
    text = seen.decode()
    assert "fit a: networks" in text
    assert "━" in text
    assert "fit a: done" in text
    assert MARK not in text


def _read(terminal: int) -> bytes:
    try:
        return os.read(terminal, 65_536)
    except OSError:  # as the other end closes
        return b""
