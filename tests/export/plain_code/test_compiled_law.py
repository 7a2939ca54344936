"""A law stepped by its compiled C: the gate takes what agrees and no more; without a compiler onnxruntime steps."""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cloudpickle
import numpy as np
import pytest
from shipped_files import ARTIFACTS

from loopwright.pipeline.errors import ExportError, HostError
from loopwright.pipeline.export.plain_code import compiled_law as module
from loopwright.pipeline.export.plain_code.c_compiler import CCompiler
from loopwright.pipeline.export.plain_code.compiled_law import MOST_KEPT, compiled_law, kit_difference, law_stepping
from loopwright.serving import Controller
from loopwright.serving.conformance.kit import KIT_TOLERANCE

if shutil.which("cc") is None:
    pytest.skip("no C compiler is installed (Debian: apt install gcc)", allow_module_level=True)

pytest_plugins = ["small_laws", "operated_laws", "course_files"]
PID = ARTIFACTS / "ph_neutralization/pid.onnx"


@pytest.fixture(autouse=True)
def kept(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The folder of kept libraries, empty at first."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.delenv("CC", raising=False)
    return tmp_path / "cache" / "loopwright" / "compiled-laws"


@pytest.fixture
def altered(monkeypatch: pytest.MonkeyPatch) -> Callable[[str], None]:
    """Puts a statement at the end of each step's text."""

    def alter(statement: str) -> None:
        whole = module.c_step

        def changed(*given: object) -> dict[str, str]:
            texts = whole(*given)  # type: ignore[arg-type]
            source = texts["law.c"].rstrip()
            assert source.endswith("}")
            return texts | {"law.c": f"{source[:-1]}    {statement}\n}}\n"}

        monkeypatch.setattr(module, "c_step", changed)

    return alter


def drawn(controller: Controller, n: int) -> np.ndarray:
    """Rows (n, n_in) as ``Controller.compute`` takes them, each input within its range."""
    rng, rows = np.random.default_rng(5), np.zeros((n, controller.width))
    for name in controller.manifest.inputs:
        place, signals = controller.places[name], controller.manifest.signals(name)
        if name == "state":
            continue
        usual = controller.manifest.usual(name)
        rows[:, place] = np.array([[rng.uniform(s.low, s.high) for s in signals] or usual for _ in range(n)])
    return rows


# ------------------------------------------------------------------------------------------------------------ the gate
def test_rows_are_those_of_onnxruntime() -> None:
    controller = Controller(PID)
    law = compiled_law(controller)
    assert 0 < law.worst <= KIT_TOLERANCE
    given = drawn(controller, 50)
    given[7, controller.places["pv"].start], given[9, 0] = np.nan, np.inf
    ours, theirs = controller.compute(given), law.compute(given)
    assert np.isnan(theirs[[7, 9]]).all()
    assert theirs == pytest.approx(ours, rel=1e-12, abs=1e-12, nan_ok=True)
    assert len(np.unique(theirs[:, controller.places["mv"]])) > 20
    assert law.compute(given[:0]).shape == (0, controller.width_out)


@pytest.mark.parametrize("fixture", ["pi_file", "operated_file", "course_file"])
def test_the_gate_takes_laws_with_each_input(fixture: str, request: pytest.FixtureRequest) -> None:
    assert compiled_law(Controller(request.getfixturevalue(fixture))).worst <= KIT_TOLERANCE


def test_the_gate_takes_a_law_whose_steps_are_refused(disobedient_file: Path) -> None:
    assert compiled_law(Controller(disobedient_file)).worst <= KIT_TOLERANCE


@pytest.mark.parametrize(
    "statement",
    [
        "mv[0] += 2e-9 * 200.0;",  # of a range of 200 ml/min
        "state_next[0] *= 1.0 + 1e-6;",
        "if (pv[0] < 7.0) { mv[0] = 0.0 / 0.0 * mv[0]; }",
        "mv[0] = mv[0] > 900.0 ? 1e300 * 1e300 : mv[0];",
    ],
)
def test_c_that_computes_something_else_does_not_step(statement: str, altered: Callable[[str], None]) -> None:
    altered(statement)
    controller = Controller(PID)
    with pytest.raises(ExportError, match="parts from onnxruntime"):
        compiled_law(controller)
    stepping = law_stepping(controller, "auto")
    assert stepping.compute is None
    assert stepping.words.startswith("onnxruntime ")
    with pytest.raises(HostError, match="--law-by onnx"):
        law_stepping(controller, "c")


def test_other_last_digits_pass(altered: Callable[[str], None]) -> None:
    altered("mv[0] += 2e-10 * 200.0;")
    law = compiled_law(Controller(PID))
    assert law.worst == pytest.approx(2e-10, rel=0.01)
    assert law_stepping(Controller(PID), "c").compute is not None


def test_a_number_for_a_row_that_must_have_none_is_a_difference() -> None:
    controller = Controller(PID)
    assert kit_difference(controller, controller.compute).largest == 0
    assert kit_difference(controller, lambda given: np.nan_to_num(controller.compute(given))).largest == np.inf


# -------------------------------------------------------------------------------------------------------- the compiler
def test_a_machine_without_a_compiler_steps_by_onnxruntime(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("PATH", str(tmp_path))
    controller = Controller(PID)
    stepping = law_stepping(controller, "auto")
    assert stepping.compute is None
    assert "no C compiler is installed" in stepping.words
    with pytest.raises(HostError, match="no C compiler is installed"):
        law_stepping(controller, "c")
    assert law_stepping(controller, "onnx").compute is None


@pytest.mark.parametrize(
    ("compiler", "words"),
    [
        ("false", "does not say its version"),
        ("cc -no-such-option", "cannot compile the law"),
        ("cc '", "is no command line"),
        ("cc -ffast-math", "ffast-math"),
    ],
)
def test_a_compiler_that_does_not_compile_is_as_none(
    compiler: str, words: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("CC", compiler)
    assert words in law_stepping(Controller(PID), "auto").words
    with pytest.raises(HostError, match=words):
        law_stepping(Controller(PID), "c")


def test_onnx_asks_for_no_compiler(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "compiled_law", None)
    assert law_stepping(Controller(PID), "onnx").compute is None


# --------------------------------------------------------------------------------------------------- what was compiled
def no_compiling(*_: object) -> None:
    raise AssertionError("compiled again")


def test_a_law_is_compiled_once(kept: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    first = compiled_law(Controller(PID))
    (file,) = kept.iterdir()
    monkeypatch.setattr(CCompiler, "compile", no_compiling)
    assert compiled_law(Controller(PID)) == first
    for owner, name, value in (
        (CCompiler, "version", lambda _: "another release"),
        (module, "FLAGS", (*module.FLAGS, "-g")),
    ):
        with monkeypatch.context() as here:
            here.setattr(owner, name, value)
            with pytest.raises(AssertionError, match="compiled again"):
                compiled_law(Controller(PID))
    with pytest.raises(AssertionError, match="compiled again"):
        compiled_law(Controller(PID), "-O1")
    with pytest.raises(AssertionError, match="compiled again"):
        compiled_law(Controller(PID.with_stem("minimum_variance")))
    assert list(kept.iterdir()) == [file]


@pytest.mark.parametrize(
    "spoil", [lambda b: b[:-100], lambda b: b"", lambda b: b[:4000] + bytes([b[4000] ^ 1]) + b[4001:]]
)
def test_a_kept_library_that_is_not_whole_is_compiled_again(spoil: Callable[[bytes], bytes], kept: Path) -> None:
    first = compiled_law(Controller(PID))
    (file,) = kept.iterdir()
    whole = file.read_bytes()
    spoilt = spoil(whole)
    assert spoilt != whole
    file.write_bytes(spoilt)
    assert compiled_law(Controller(PID)).worst == first.worst
    assert len(file.read_bytes()) == len(whole)


def test_what_fails_keeps_nothing(kept: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("CC", "cc -no-such-option")
    assert law_stepping(Controller(PID), "auto").compute is None
    assert not kept.exists()


def test_where_nothing_can_be_kept_it_is_compiled_each_time(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "file").write_text("")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "file"))
    assert compiled_law(Controller(PID)).worst <= KIT_TOLERANCE


def test_the_libraries_that_were_used_last_stay(kept: Path) -> None:
    kept.mkdir(parents=True)
    old = [kept / f"{k:064x}" for k in range(MOST_KEPT + 3)]
    for k, path in enumerate(old):
        path.write_bytes(b"")
        os.utime(path, (k, k))
    compiled_law(Controller(PID))
    left = set(kept.iterdir())
    assert len(left) == MOST_KEPT
    assert [path in left for path in old] == [k >= 4 for k in range(len(old))]


def test_a_worker_steps_by_the_same_library_and_another_machine_refuses_it() -> None:
    controller = Controller(PID)
    law, given = compiled_law(controller), drawn(controller, 5)
    there = cloudpickle.loads(cloudpickle.dumps(law.compute))
    assert np.array_equal(there(given), law.compute(given))
    with pytest.raises(HostError, match="compiled for plan9 z80"):
        replace(law, machine="plan9 z80").compute(given)
    with pytest.raises(HostError, match="cannot be loaded"):
        replace(law, library=b"no library").compute(given)
