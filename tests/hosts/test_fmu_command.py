"""`loopwright fmu`: what it writes, and one line for what it cannot."""

from __future__ import annotations

import shutil
import sys
import tomllib
import zipfile
from hashlib import sha256
from pathlib import Path

import pytest
from controller_fmus import MISSING, file_of
from kits import ROOT

from loopwright.pipeline.__main__ import main
from loopwright.pipeline.commands import OneLineParser
from loopwright.pipeline.commands.fmu import options
from loopwright.pipeline.export.plain_code import lowering
from loopwright.pipeline.hosts.fmu.compiling import HEADER, HOSTS, SHIPPED, SHIPPED_SHA256, SOURCES
from loopwright.pipeline.hosts.fmu.variables import variables_of
from loopwright.serving import Controller

if MISSING:
    pytest.skip(MISSING, allow_module_level=True)
fmpy = pytest.importorskip("fmpy")

Capture = pytest.CaptureFixture[str]
PID = file_of("thiosulfate_cstr/pid")


def refused(capsys: Capture, *words: str | Path) -> str:
    """The one line of a command that ends with 2."""
    try:
        status = main(["fmu", *map(str, words)])
    except SystemExit as end:
        status = int(end.code or 0)
    told = capsys.readouterr()
    assert status == 2
    assert told.out == ""
    assert told.err.startswith("loopwright fmu: ")
    assert told.err.count("\n") == 1
    return told.err


@pytest.mark.parametrize("fmi", [2, 3])
def test_the_command_writes_an_fmu(fmi: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: Capture) -> None:
    monkeypatch.chdir(tmp_path)
    shutil.copy(PID, tmp_path / "my loop-1.onnx")
    words = ["fmu", "my loop-1.onnx"]
    assert main(words if fmi == 3 else [*words, "--fmi", "2"]) == 0
    told = capsys.readouterr().out
    assert told.startswith(f"my loop-1.fmu: FMI {fmi}.0, ")
    assert told.endswith(" steps give the same bits as the plain C's statements\n")
    assert (tmp_path / "my loop-1.fmu").stat().st_size < 100_000
    model = fmpy.read_model_description("my loop-1.fmu")
    assert model.fmiVersion == f"{fmi}.0"
    assert model.coSimulation.modelIdentifier == "my_loop_1"
    assert sorted(path.name for path in tmp_path.iterdir()) == ["my loop-1.fmu", "my loop-1.onnx"]  # and no draft
    assert "my loop-1.fmu is there already; remove it" in refused(capsys, *words[1:])


def test_the_command_can_put_onnxruntime_into_the_fmu(tmp_path: Path, capsys: Capture) -> None:
    assert main(["fmu", str(PID), "--onnxruntime", "--out", str(tmp_path / "x.fmu")]) == 0
    assert capsys.readouterr().out.endswith(" steps give the same bits as the controller file\n")
    with zipfile.ZipFile(tmp_path / "x.fmu") as made:
        assert made.read("resources/controller.onnx") == PID.read_bytes()


def test_a_law_without_plain_c_is_pointed_to_onnxruntime(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: Capture
) -> None:
    """As of an operator that no statement stands for."""
    known = {name: row for name, row in lowering.ONE_OF_TWO.items() if name != "Mul"}
    monkeypatch.setattr(lowering, "ONE_OF_TWO", known)
    told = refused(capsys, PID, "--out", tmp_path / "x.fmu")
    assert "operator Mul" in told
    assert "--onnxruntime" in told
    assert not list(tmp_path.iterdir())
    assert main(["fmu", str(PID), "--onnxruntime", "--out", str(tmp_path / "x.fmu")]) == 0


def test_a_file_that_is_no_controller_is_refused(tmp_path: Path, capsys: Capture) -> None:
    out = ("--out", tmp_path / "x.fmu")
    text, cut = tmp_path / "text.onnx", tmp_path / "cut.onnx"
    text.write_text("not a controller")
    cut.write_bytes(PID.read_bytes()[:-100])
    for file in (text, cut, tmp_path / "none.onnx", PID.with_suffix(".json")):
        assert str(file) in refused(capsys, file, *out)
    assert not (tmp_path / "x.fmu").exists()


def test_an_output_that_cannot_be_is_refused(tmp_path: Path, capsys: Capture) -> None:
    (tmp_path / "there.fmu").write_text("")
    for name, words in (
        ("there.fmu", "is there already; remove it, or name another file with --out"),
        ("x.zip", "does not end in .fmu"),
        ("none/x.fmu", "is no folder"),
        ("there.fmu/x.fmu", "is no folder"),
    ):
        assert words in refused(capsys, PID, "--out", tmp_path / name)
    assert (tmp_path / "there.fmu").read_text() == ""
    if sys.platform == "linux":  # where not even root can write
        assert "/proc" in refused(capsys, PID, "--out", "/proc/x.fmu")


def test_a_version_of_fmi_that_there_is_none_of_is_refused(capsys: Capture) -> None:
    assert "invalid choice: 1 (choose from 2, 3)" in refused(capsys, PID, "--fmi", "1")


def test_what_is_missing_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: Capture) -> None:
    words = (PID, "--out", tmp_path / "x.fmu")
    with monkeypatch.context() as here:
        here.setenv("CC", "no-such-compiler -O2")
        assert "no C compiler is installed: CC names 'no-such-compiler'" in refused(capsys, *words)
    with monkeypatch.context() as here:
        here.delenv("CC", raising=False)
        here.setenv("PATH", str(tmp_path))
        assert "none of cc, gcc, clang is there; apt-get install gcc brings one" in refused(capsys, *words)
    with monkeypatch.context() as here:
        here.setitem(sys.modules, "fmpy", None)
        assert "an FMU needs the package fmpy: pip install 'loopwright[fmu]'" in refused(capsys, *words)
    with monkeypatch.context() as here:
        here.setattr(sys, "platform", "win32")
        assert "an FMU is built on Linux" in refused(capsys, *words)
    with monkeypatch.context() as here:
        here.setattr("loopwright.pipeline.hosts.fmu.compiling._library", lambda: Path("/x/libonnxruntime.so.1.20.1"))
        told = refused(capsys, *words, "--onnxruntime")
        assert "onnxruntime here is 1.20, older than its header of 1.21; pip install 'onnxruntime>=1.21'" in told
    with monkeypatch.context() as here:
        here.setattr("importlib.util.find_spec", lambda name: None)
        assert "onnxruntime here has no libonnxruntime.so" in refused(capsys, *words, "--onnxruntime")


def test_a_compiler_that_fails_is_one_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: Capture) -> None:
    monkeypatch.setenv("CC", "gcc -DLAW_CALL=0 -Werror")  # the sources define it too
    told = refused(capsys, PID, "--out", tmp_path / "x.fmu")
    assert "cannot compile the FMU: " in told
    assert "LAW_CALL" in told
    assert not list(tmp_path.iterdir())


def test_the_page_names_every_option_and_variable() -> None:
    page = (ROOT / "docs" / "fmu.md").read_text()
    parser = OneLineParser()
    options(parser)
    names = {name for action in parser._actions for name in action.option_strings} - {"-h", "--help"}
    assert names == {"--out", "--fmi", "--onnxruntime"}
    assert all(f"{name} " in page or f"`{name}`" in page for name in names)
    groups = {row.group for row in variables_of(Controller(PID).manifest)} - {"time"}
    assert groups == {"sp", "pv", "mv_applied", "mv_start", "mv", "info", "fault", "use_mv_applied"}
    assert all(f"`{group}" in page for group in (*groups, "dv."))
    assert "**Not tested: Simulink, OpenModelica, Dymola" in page


def test_the_package_ships_what_is_compiled() -> None:
    """The globs of package data name every file that the command reads."""
    data = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["setuptools"]["package-data"][
        "loopwright.pipeline"
    ]
    shipped = {path for glob in data for path in (ROOT / "pipeline").glob(glob)}
    read = {HOSTS / "c" / "host.c", HOSTS / "c" / "controller.c", *SHIPPED.iterdir(), *SOURCES.iterdir()}
    assert {path.resolve() for path in read} <= {path.resolve() for path in shipped}
    assert {path.name for path in SHIPPED.iterdir()} == {HEADER, "LICENSE"}
    assert sha256((SHIPPED / HEADER).read_bytes()).hexdigest() == SHIPPED_SHA256
    assert "#define ORT_API_VERSION 21\n" in (SHIPPED / HEADER).read_text()
    assert "MIT License" in (SHIPPED / "LICENSE").read_text()
    for name in ("host.c", "controller.c"):
        assert (ROOT / "examples" / "embed" / "c" / "onnxruntime" / name).resolve() == (HOSTS / "c" / name).resolve()
    shared = ROOT / "examples" / "embed" / "javascript" / "controller.mjs"
    assert shared.resolve() == (HOSTS / "javascript" / "controller.mjs").resolve()
    assert shared.resolve() in {path.resolve() for path in shipped}
