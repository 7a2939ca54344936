"""``loopwright certify``: its plan before the first loop, its certificate in the file, loops again, and refusals."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import pytest
from undrawn import draw_nothing

from loopwright.pipeline.__main__ import main
from loopwright.pipeline.commands import certify
from loopwright.pipeline.errors import PlantError
from loopwright.pipeline.evaluation.certificate.bound import at_most_fail
from loopwright.pipeline.tracking.card import version_description
from loopwright.pipeline.tracking.gate import Gate
from loopwright.serving import Controller
from loopwright.serving.certificate import Certificate, certificate_of
from loopwright.serving.signing.keys import make_pair
from loopwright.serving.signing.sign import sign
from loopwright.serving.signing.verify import verified

ROOT = Path(__file__).parents[2]
PH = ROOT / "artifacts/ph_neutralization/pid.onnx"
OUT = Path("ph_neutralization-pid-certificate")
FEW = ["--loops", "8", "--workers", "1", "--law-by", "onnx"]
TIGHT = ["--limit", "mae=0.1"]  # which some of the loops exceed


@pytest.fixture(autouse=True)
def _in_a_folder_of_its_own(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / ".cache"))  # of the compiled law


def certificate_in(file: Path) -> Certificate:
    controller = Controller(file)
    found = certificate_of(controller.manifest, controller.law_sha256).certificate
    assert found is not None
    return found


def test_the_plan_is_written_before_the_first_loop(monkeypatch: pytest.MonkeyPatch) -> None:
    plans = []
    run = certify.outcomes_of

    def seen(*given: Any) -> Any:
        plans.append(json.loads((OUT / "plan.json").read_text()))
        return run(*given)

    monkeypatch.setattr(certify, "outcomes_of", seen)
    assert main(["certify", str(PH), *FEW]) == 0
    found = certificate_in(OUT / "pid.onnx")
    (plan,) = plans
    assert (plan["plan"], plan["seed"], plan["loops"]) == (found.plan, found.seed, 8)
    assert plan["law"] == found.law == Controller(PH).law_sha256
    assert plan["family"] == found.family.to_dict()
    assert found.at_most == at_most_fail(found.failures, 8, 0.99)


def test_the_file_keeps_its_evidence_and_inspect_shows_the_certificate(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["certify", str(PH), *FEW]) == 0
    printed = capsys.readouterr().out
    evidence = Controller(OUT / "pid.onnx").manifest.evidence
    assert evidence.pop("certificate")
    assert evidence == Controller(PH).manifest.evidence
    found = certificate_in(OUT / "pid.onnx")
    assert found.sentence in printed
    assert main(["inspect", str(OUT / "pid.onnx")]) == 0
    assert found.sentence in capsys.readouterr().out
    controller = Controller(OUT / "pid.onnx")
    read = certificate_of(controller.manifest, controller.law_sha256)
    gate = Gate.of(None, "pid")
    assert found.sentence in version_description(None, gate, "run", None, certificate=read)
    assert "Certificate" not in version_description(None, gate, "run", None)


def test_a_failed_loop_runs_again_as_it_ran(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    draw_nothing(monkeypatch)
    assert main(["certify", str(PH), *FEW, *TIGHT]) == 0
    every = json.loads((OUT / "certificate.json").read_text())["failed"]
    found = certificate_in(OUT / "pid.onnx")
    assert 0 < found.failures < 8
    assert list(every) == list(found.failed)
    loop, (how,) = next(iter(every.items()))
    assert f"certify {OUT / 'pid.onnx'} --replay {loop}" in capsys.readouterr().out
    assert main(["certify", str(OUT / "pid.onnx"), "--replay", loop, "--law-by", "onnx"]) == 0
    again = capsys.readouterr().out
    value = float(how.split()[1])
    (mae,) = [float(line.split()[-1]) for line in again.splitlines() if line.split()[:1] == ["MAE"]]
    assert mae == pytest.approx(value, rel=1e-3)
    assert f"loop {loop} of seed {found.seed}" in again
    assert how in again
    assert (OUT / f"loop_{loop}.png").exists()


def test_the_same_plan_gives_the_same_certificate() -> None:
    for out, batch in (("one", "3"), ("two", "100")):
        assert main(["certify", str(PH), *FEW, "--out", out, "--batch", batch]) == 0
    assert certificate_in(Path("one/pid.onnx")) == certificate_in(Path("two/pid.onnx"))
    assert Path("one/pid.onnx").read_bytes() == Path("two/pid.onnx").read_bytes()
    assert main(["certify", "one/pid.onnx", *FEW, "--out", "three"]) == 0  # of a file that has one already
    assert Path("three/pid.onnx").read_bytes() == Path("one/pid.onnx").read_bytes()


def test_params_yaml_says_what_the_certificate_rests_on() -> None:
    Path("params.yaml").write_text(
        "cases:\n  ph_neutralization:\n    held_out_seeds: [7]\n    certificate: {spread: 3, swings: true}\n"
    )
    assert main(["certify", str(PH), *FEW, "--plan-only"]) == 0
    plan = json.loads((OUT / "plan.json").read_text())
    assert plan["family"]["spread"] == 0.03
    assert plan["family"]["held_out"] == [7]
    assert "swings to the end" in plan["fails_if"]
    assert plan["loops"] == 8
    assert not (OUT / "pid.onnx").exists()


def test_a_certified_copy_of_a_signed_file_is_signed_anew(capsys: pytest.CaptureFixture[str]) -> None:
    public, _ = make_pair(Path("anna.key"), "p256", None)
    from loopwright.serving.signing.keys import PrivateKey

    key = PrivateKey.read(Path("anna.key"), None)
    for end in (".onnx", ".json"):
        shutil.copy(PH.with_suffix(end), f"pid{end}")
    sign(Path("pid.onnx"), key)
    assert main(["certify", "pid.onnx", *FEW]) == 0
    assert f"loopwright sign {OUT / 'pid.onnx'}" in capsys.readouterr().out
    assert verified(Path("pid.onnx"), [public])  # as before
    sign(OUT / "pid.onnx", key)
    assert verified(OUT / "pid.onnx", [public])
    assert certificate_in(OUT / "pid.onnx")


# ---------------------------------------------------------------------- what is refused, in one line
def refused(capsys: pytest.CaptureFixture[str], *words: str) -> str:
    assert main(["certify", *words]) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1
    assert "Traceback" not in error
    return error


def test_another_plan_than_the_one_that_was_fixed_is_refused(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["certify", str(PH), *FEW, "--plan-only"]) == 0
    first = (OUT / "plan.json").read_bytes()
    assert "fixed first (8 loops" in refused(capsys, str(PH), "--loops", "9")
    assert main(["certify", str(PH), *FEW]) == 0
    assert (OUT / "plan.json").read_bytes() == first


def test_too_few_loops_and_figures_that_are_none_are_refused(capsys: pytest.CaptureFixture[str]) -> None:
    assert "too few to say anything" in refused(capsys, str(PH), "--loops", "3")
    assert "did you mean 'mae'" in refused(capsys, str(PH), "--limit", "mea=1")
    assert not OUT.exists()
    for option, word in (("--limit", "mae"), ("--limit", "mae=x"), ("--confidence", "100"), ("--loops", "0")):
        with pytest.raises(SystemExit):
            main(["certify", str(PH), option, word])
        assert capsys.readouterr().err.count("\n") == 1


def test_files_that_are_none_of_ours_or_of_no_case_are_refused(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    Path("foreign.onnx").write_bytes(b"not a graph")
    assert "foreign.onnx" in refused(capsys, "foreign.onnx")
    assert "cannot be read" in refused(capsys, "nowhere.onnx")
    monkeypatch.setattr("loopwright.pipeline.commands.arguments.all_cases", dict)
    assert "no case here" in refused(capsys, str(PH))


def test_a_plant_of_which_no_other_can_be_drawn_has_no_family(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def none(*_: object) -> dict[str, tuple[float, float]]:
        raise PlantError("plant 'bare' has no parameters, so no other plant can be drawn")

    monkeypatch.setattr("loopwright.pipeline.evaluation.stress.draws.Drawing.ranges", none)
    assert "no other plant can be drawn" in refused(capsys, str(PH))
    assert not OUT.exists()


def test_a_loop_that_is_not_in_a_certificate_is_refused(capsys: pytest.CaptureFixture[str]) -> None:
    assert "it holds no certificate" in refused(capsys, str(PH), "--replay", "1")
    assert main(["certify", str(PH), *FEW]) == 0
    assert "has the loops 0 to 7" in refused(capsys, str(OUT / "pid.onnx"), "--replay", "8")


def test_a_folder_of_something_else_is_refused(capsys: pytest.CaptureFixture[str]) -> None:
    Path("taken").write_text("mine")
    assert "taken is no folder" in refused(capsys, str(PH), *FEW, "--out", "taken")
    Path("here").mkdir()
    shutil.copy(PH, "here/pid.onnx")
    assert "is the file itself" in refused(capsys, "here/pid.onnx", *FEW, "--out", "here")
