"""What the check of params.yaml finds, with one line for each mistake, before any stage runs."""

from __future__ import annotations

from copy import deepcopy
from pathlib import Path
from typing import Any

import pytest
import yaml

from loopwright.pipeline.__main__ import main
from loopwright.pipeline.cases import CASES
from loopwright.pipeline.cases.ph_neutralization.case import PhNeutralizationCase
from loopwright.pipeline.plants.equations import EquationPlant
from loopwright.pipeline.stages import check

ROOT = Path(__file__).parents[2]


@pytest.fixture(scope="module")
def whole() -> dict[str, Any]:
    """The repository's own params.yaml, read once: it is long."""
    tree: dict[str, Any] = yaml.safe_load((ROOT / "params.yaml").read_text())
    return tree


@pytest.fixture
def params(whole: dict[str, Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> dict[str, Any]:
    """The same in a folder of its own, which ``checked`` writes anew."""
    (tmp_path / "pipeline").mkdir()
    (tmp_path / "pipeline" / "cases").symlink_to(ROOT / "pipeline" / "cases")  # which nothing here changes
    monkeypatch.chdir(tmp_path)
    return deepcopy(whole)


def checked(tree: dict[str, Any]) -> list[str]:
    # Not as text of the original: anchors would carry a mistake to other sections.
    Path("params.yaml").write_text(yaml.dump(tree))
    return check.mistakes()


def test_the_repositorys_own_has_none(params: dict[str, Any], capsys: pytest.CaptureFixture[str]) -> None:
    assert checked(params) == []
    assert main(["check"]) == 0
    assert f"{len(params['controllers'])} controllers" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("where", "value", "said"),
    [
        (("cases", "batch_reactor", "held_out_seeds"), [11, 12], "none of the development seeds"),
        (("records", "ph_neutralization-aprbs", "kind"), "aprb", "did you mean 'aprbs'"),
        (("records", "ph_neutralization-aprbs", "samples"), "many", "samples"),
        (("records", "ph_neutralization-aprbs", "samples"), 0, "samples is 0; it must be at least 1"),
        (("models", "batch_reactor-nnarx", "data"), "work/batch_reactor/records/batch", "which no record makes"),
        (("models", "batch_reactor-nnarx", "data"), "mine.csv", "which is not there"),
        (("models", "batch_reactor-nnarx", "parts", "arx", "kind"), "arxx", "did you mean 'arx'"),
        (("models", "thiosulfate_cstr-three_periods", "parts", "forward", "trainer", "kind"), "ml", "trainer"),
        (
            ("models", "ph_neutralization-identification_example", "case"),
            "batch",
            "call the section batch-identification_example",
        ),
        (("controllers", "batch_reactor-pid", "law"), "pit", "did you mean 'pid'"),
        (("controllers", "batch_reactor-pid", "name"), "fast", "or call the section batch_reactor-fast"),
        (("controllers", "batch_reactor-pid", "model"), "linear", "has the model sets"),
        (("controllers", "thiosulfate_cstr-incad", "model"), "three_periods", "needs a part 'domain'"),
        (("controllers", "jacketed_batch_reactor-fuzzy_feedforward_pi", "part"), "tide", "needs a part 'tide'"),
        (("controllers", "reversible_cstr-pid", "kc"), 0, "kc of the PID is 0.0; it must be finite and not 0"),
        (("controllers", "batch_reactor-pid", "case"), "ph_neutralization", "call the section ph_neutralization-pid"),
        (("controllers", "batch_reactor-pid", "tunings"), "imc", "unknown key 'tunings'"),
        (("controllers", "thiosulfate_cstr-incad", "variants", "r=1"), {"q": 1.0}, "variants.r=1: unknown key 'q'"),
    ],
)
def test_one_mistake_is_one_line(params: dict[str, Any], where: tuple[str, ...], value: Any, said: str) -> None:
    section = params
    for key in where[:-1]:
        section = section[key]
    section[where[-1]] = value
    (line,) = checked(params)
    assert said in line
    assert f"{where[0]}.{where[1]}" in line


def test_every_mistake_is_told_and_the_exit_says_so(params: dict[str, Any], capsys: pytest.CaptureFixture[str]) -> None:
    params["records"]["ph_neutralization-aprbs"]["kind"] = "aprb"
    params["controllers"]["batch_reactor-pid"]["law"] = "pit"
    assert len(checked(params)) == 2
    assert main(["check"]) == 2
    lines = capsys.readouterr().err.splitlines()
    assert [line.partition(":")[0] for line in lines] == ["check", "check"]


class Unwritten(EquationPlant):
    """A plant without equations."""


def test_an_abstract_plant_is_told_before_the_run(params: dict[str, Any], monkeypatch: pytest.MonkeyPatch) -> None:
    class Case(PhNeutralizationCase):
        __module__ = PhNeutralizationCase.__module__  # whose folder it shares
        plant_class = Unwritten

    monkeypatch.setitem(CASES, "ph_neutralization", Case())
    lines = checked(params)
    assert len(lines) == 1 + sum("controllers.ph_neutralization-" in line for line in lines)
    assert "plant class Unwritten is abstract, as it lacks derivative" in lines[0]


def test_a_case_without_tests_is_told_before_the_run(params: dict[str, Any], monkeypatch: pytest.MonkeyPatch) -> None:
    class Case(PhNeutralizationCase):
        __module__ = PhNeutralizationCase.__module__  # whose folder it shares

        def scenarios(self) -> Any:
            return {}

    monkeypatch.setitem(CASES, "ph_neutralization", Case())
    (line,) = checked(params)
    assert "case 'ph_neutralization' has no tests" in line


@pytest.mark.parametrize(
    ("tuning", "said"), [("simc", "SIMC needs stable real poles"), ("itae", "needs a stable plant")]
)
def test_a_tuning_that_does_not_apply_is_told_before_the_run(params: dict[str, Any], tuning: str, said: str) -> None:
    params["controllers"]["thiosulfate_cstr-pid"]["tuning"] = tuning  # at the unstable point
    (line,) = checked(params)
    assert line.startswith("controllers.thiosulfate_cstr-pid")
    assert said in line


def test_bounds_that_are_missing_are_a_note_and_no_mistake(
    params: dict[str, Any], capsys: pytest.CaptureFixture[str]
) -> None:
    params["cases"]["thiosulfate_cstr"]["held_out_seeds"] = [90_001]
    assert checked(params) == []
    assert main(["check"]) == 0
    said = capsys.readouterr().err.splitlines()
    assert said
    for line in said:
        assert line.startswith("check: note: ")
        assert "figures of scenario 'held_out' (seeds [90001])" in line
