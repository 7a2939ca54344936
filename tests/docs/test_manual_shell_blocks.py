"""The shell blocks of the manual run in an empty folder that holds what a clone holds, and print what the pages state.

All in this process: ``loopwright`` by its own ``main``, a program of the examples by its file. Marks say what is left
out.
"""

from __future__ import annotations

import runpy
import shutil
import sys
from pathlib import Path

import pytest
from pages import PAGES, ROOT, Block, blocks
from stated import assert_stated, says
from test_manual_code_blocks import commands_of

from loopwright.pipeline.__main__ import main
from loopwright.serving.__main__ import main as serving

EMPTY = "cases: {}\nrecords: {}\nmodels: {}\ncontrollers: {}\n"


def runs(block: Block) -> list[list[str]]:
    """The commands of a block that are run here."""
    found = commands_of(block)
    if block.mark is None:
        return found
    kind, words = block.mark
    if kind != "run in part":
        return []
    pieces = [piece.strip() for piece in words.split(": ")[0].split(",")]
    some = [command for command in found if any(piece in " ".join(command) for piece in pieces)]
    assert len(words.split(": ", 1)[1]) > 10, f"{block.where}: say why the others do not run"
    for piece in pieces:
        assert any(piece in " ".join(command) for command in some), f"{block.where}: {piece!r} is in no command"
    return some


SHELL = {page: [b for b in blocks(page) if b.language in {"sh", "bash"}] for page in PAGES}


def run(words: list[str]) -> None:
    """One command, as a shell in this folder would."""
    program, *rest = words
    if program == "loopwright":
        if "--check" in words:  # the answers of a host
            run(["python", "examples/embed/python/conformance.py", words[3], words[-1]])
        assert main(rest) == 0, words
    elif program == "python" and rest[:2] == ["-m", "loopwright.serving"]:
        assert not serving(rest[2:]), words
    elif program == "python":
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(sys, "argv", rest)
            status: object = 0
            try:
                runpy.run_path(rest[0], run_name="__main__")
            except SystemExit as end:
                status = end.code
            assert not status, words
    else:
        pytest.fail(f"{program} is no program that this test runs: give its block a mark")


@pytest.mark.parametrize(
    "page", [p for p in PAGES if any(map(runs, SHELL[p]))], ids=lambda p: p.relative_to(ROOT).as_posix()
)
def test_the_commands_of_a_page_run(
    page: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    for name in ("artifacts", "examples"):
        (tmp_path / name).symlink_to(ROOT / name)
    for file in ("pid.onnx", "pid.json"):
        shutil.copy(ROOT / "artifacts" / "thiosulfate_cstr" / file, tmp_path)
    (tmp_path / "params.yaml").write_text(EMPTY)
    monkeypatch.chdir(tmp_path)
    every = blocks(page)
    for block in SHELL[page]:
        commands = runs(block)
        for command in commands:
            run(command)
        printed = capsys.readouterr().out
        after = next((b for b in every if b.line > block.line), None)
        if commands and after is not None and after.language == "text":
            made = [w for w in commands[-1] if w.endswith(".csv") and Path(w).is_file()] if not printed.strip() else []
            assert_stated(
                after.text, "".join(Path(w).read_text(encoding="utf-8") for w in made) or printed, after.where
            )


def test_a_stated_number_is_held_to_the_digits_shown() -> None:
    assert says("gain -0.0455 in 26 s", "gain -0.04549 in 26 s")
    assert not says("gain -0.0455 in 26 s", "gain -0.0456 in 26 s")
    assert says("T_j [K]: [433.6...]", "T_j [K]: [433.63121]")
    assert not says("T_j [K]: [433.6...]", "T_j [K]: [433.53121]")
    assert not says("AUTO [1.0]", "HOLD [1.0]")


def test_marks_do_not_leave_everything_out() -> None:
    assert sum(len(runs(block)) for found in SHELL.values() for block in found) >= 19
