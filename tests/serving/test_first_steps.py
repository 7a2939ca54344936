"""A new file takes its first steps in a process that may die before it enters one that writes to a plant."""

from __future__ import annotations

import copy
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from killers import blind_children, killer
from shipped_files import SHIPPED

from loopwright.serving import ArtifactError, Controller, OutputError, SignatureError, first_steps
from loopwright.serving.first_steps import take, tried

pytest_plugins = ["small_laws", "operated_laws"]


def test_what_was_tried_is_what_is_loaded(pi_file: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert tried(pi_file).sha256 == Controller(pi_file).sha256
    file = tmp_path / "x.onnx"
    file.write_bytes(pi_file.read_bytes())
    of_old = first_steps._digest_tried(file, None)

    def replaced(*_: Any) -> str:
        file.write_bytes(SHIPPED[0].read_bytes())
        return of_old

    monkeypatch.setattr(first_steps, "_digest_tried", replaced)
    with pytest.raises(ArtifactError, match="not the pinned"):
        tried(file)


def test_a_file_that_ends_its_process_is_refused_and_ends_no_other(
    controller: Controller, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    file = killer(tmp_path / "killer.onnx", controller.manifest)
    with pytest.raises(ArtifactError, match="has no name"):  # as the audit says it in the child
        tried(file)
    blind_children(monkeypatch, tmp_path / "blind")
    with pytest.raises(ArtifactError, match="SIGSEGV") as caught:
        tried(file)
    assert "\n" not in str(caught.value)


def test_a_law_that_operators_steer_is_tried_at_both_ends(operated_file: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    controller, seen = Controller(operated_file), set()
    step = controller.step

    def counted(**given: Any) -> Any:
        seen.add(tuple(map(float, given.get("operate", ()))))
        seen.add(tuple(map(float, given.get("fresh", ()))))
        return step(**given)

    monkeypatch.setattr(controller, "step", counted)
    take(controller)
    ends = {tuple(getattr(e, end) for e in controller.manifest.operate) for end in ("low", "high")}
    assert seen == {(), *ends, (0.0, 0.0)}
    assert tried(operated_file).sha256 == controller.sha256


def fails(error: Exception) -> Callable[..., Any]:
    def run(*_: Any, **__: Any) -> Any:
        raise error

    return run


def test_nothing_is_imported_from_the_folder_in_which_somebody_stands(
    pi_file: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for module in ("numpy", "signal", "loopwright"):
        (tmp_path / f"{module}.py").write_text("open('ran', 'w').close()\nraise SystemExit('hijacked')\n")
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("PYTHONPATH", raising=False)
    monkeypatch.setattr(sys, "path", ["", *sys.path])  # as of an interactive Python
    assert tried(pi_file).sha256 == Controller(pi_file).sha256
    assert not (tmp_path / "ran").exists()


@pytest.mark.parametrize(
    ("status", "says", "words"),
    [
        (
            1,
            "Traceback (most recent call last):\nImportError: no \x1b[2Jnumpy\n",
            "status 1: ImportError: no \\x1b[2Jnumpy",
        ),
        (3, "", "status 3: it said nothing"),
        (2, "a library warns\npi.onnx: it is none\n", "pi.onnx: it is none"),
        (-9, "", "it ended the process that tried its first steps (SIGKILL)"),
    ],
)
def test_what_the_process_said_last_is_quoted(
    pi_file: Path, monkeypatch: pytest.MonkeyPatch, status: int, says: str, words: str
) -> None:
    monkeypatch.setattr(subprocess, "run", lambda *_, **__: subprocess.CompletedProcess((), status, "", says))
    with pytest.raises(ArtifactError) as caught:
        tried(pi_file)
    assert words in str(caught.value)
    assert "\n" not in str(caught.value)


def test_what_libraries_say_first_is_no_digest(pi_file: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    digest = Controller(pi_file).sha256
    said = subprocess.CompletedProcess((), 0, f"a library greets\n{digest}\n", "")
    monkeypatch.setattr(subprocess, "run", lambda *_, **__: said)
    assert tried(pi_file).sha256 == digest


@pytest.mark.parametrize("error", [subprocess.TimeoutExpired("python", 30), OSError("no memory"), ValueError("NUL")])
def test_steps_that_do_not_end_or_begin_are_a_refusal(
    pi_file: Path, monkeypatch: pytest.MonkeyPatch, error: Exception
) -> None:
    monkeypatch.setattr(subprocess, "run", fails(error))
    with pytest.raises(ArtifactError):
        tried(pi_file)


def test_nothing_of_an_unsigned_file_is_run(pi_file: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(subprocess, "run", fails(AssertionError("it was run")))
    with pytest.raises(SignatureError):
        tried(pi_file, trusted=[])


@pytest.mark.parametrize("file", SHIPPED, ids=lambda file: f"{file.parent.name}-{file.stem}")
def test_every_shipped_file_takes_its_first_steps(file: Path) -> None:
    take(Controller(file))


def test_a_law_may_refuse_some_inputs_but_not_all(controller: Controller, monkeypatch: pytest.MonkeyPatch) -> None:
    slow = copy.copy(controller)
    (valve,) = controller.manifest.mv
    slow.manifest = replace(controller.manifest, mv=(replace(valve, max_move=1e-6),))
    slow._bind()
    with pytest.raises(OutputError):  # far from its set point it wants to move faster
        slow.step(sp=[2.0], pv=[0.0, 300.0], mv_applied=[50.0], state=slow.cold_state())
    take(slow)
    monkeypatch.setattr(slow, "step", fails(OutputError("not finite")))
    with pytest.raises(ArtifactError, match="none of its first steps"):
        take(slow)


def test_a_step_that_onnxruntime_cannot_compute_is_a_refusal(
    controller: Controller, monkeypatch: pytest.MonkeyPatch
) -> None:
    real, calls = controller.step, iter(range(100))

    def step(**given: Any) -> Any:
        if next(calls) == 10:
            raise OutputError("it cannot be computed") from RuntimeError("an index out of range")
        return real(**given)

    monkeypatch.setattr(controller, "step", step)
    with pytest.raises(ArtifactError, match="cannot be computed"):
        take(controller)
