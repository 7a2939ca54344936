"""A mode that is 1 or 2: what the loop, its guards, the cards and the simulation make of it."""

from __future__ import annotations

import csv
from pathlib import Path

import jacketed_batch_reactor_parts
import numpy as np
import pytest
from shipped import required

from loopwright.pipeline.__main__ import main
from loopwright.pipeline.cases import PLANTS
from loopwright.pipeline.export.gate import export
from loopwright.pipeline.laws import LAWS
from loopwright.serving import (
    Controller,
    ControlLoop,
    LoopError,
    Mode,
    Sample,
    SimulatedEndpoint,
    VirtualClock,
    default_guards,
)
from loopwright.serving.card import bench, card

CASE = "jacketed_batch_reactor"
PV = np.array([30.0, 35.0])


@pytest.fixture(scope="module")
def file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    plant, law = PLANTS[CASE](), LAWS["fuzzy_feedforward_observer"]
    path = tmp_path_factory.mktemp("controllers") / "observer.onnx"
    parts = jacketed_batch_reactor_parts.parts(plant)
    export(law.design(law.Params(**required(law.name)), parts, plant.signals, plant), path, case=CASE, provenance={})
    return path


@pytest.fixture
def loop(file: Path) -> ControlLoop:
    return ControlLoop(Controller(file), sp=[40.0], mv=[0.2, 1.0], mode=Mode.MANUAL)


@pytest.mark.parametrize(
    ("mv", "message"),
    [
        ([0.5, 1.5], r"the MV mode = 1\.5 is none of 1, 2"),
        ([0.5, 3.0], "the MV mode = 3 is none of 1, 2"),
        ([1.5, 2.0], r"the MV k_M = 1\.5 is outside \[0, 1\]"),
        ([0.5], r"it needs \(2,\): k_M \[-\], mode \[-\]"),
        ([0.5, float("nan")], "nan"),
    ],
)
def test_an_mv_that_cannot_be_is_refused_by_hand(loop: ControlLoop, mv: list[float], message: str) -> None:
    with pytest.raises(LoopError, match=message):
        loop.set_mv(mv)
    assert loop.mv.tolist() == [0.2, 1.0]
    loop.set_mv([0.5, 2.0])
    assert loop.mv.tolist() == [0.5, 2.0]
    assert loop.scan(Sample(PV)).mv.tolist() == [0.5, 2.0]


def test_a_loop_does_not_start_between_two_modes(file: Path) -> None:
    with pytest.raises(LoopError, match=r"mode = 1\.5 is none of 1, 2"):
        ControlLoop(Controller(file), sp=[40.0], mv=[0.2, 1.5])


def test_a_valve_that_is_read_back_half_way_holds_the_loop(loop: ControlLoop) -> None:
    loop.set_mode(Mode.AUTO)
    good = loop.scan(Sample(PV, np.array([0.2, 1.0])))
    assert (good.mode, good.fault) == (Mode.AUTO, "")
    held = loop.scan(Sample(PV, np.array([0.2, 1.4])))
    assert held.mode is Mode.HOLD
    assert held.fault == "applied MV mode is 1.4, none of 1, 2"
    assert held.mv.tolist() == good.mv.tolist()
    assert [type(g).__name__ for g in default_guards(loop.controller.manifest)].count("Allowed") == 1


def test_auto_gives_allowed_values_and_takes_over_from_the_operator(file: Path) -> None:
    """From MANUAL in the wrong mode to AUTO: heat is wanted, so the law changes the mode at once."""
    plant = PLANTS[CASE]()
    step, p = plant.stepper(), plant.parameters()
    x = [np.array([30.0, 30.0])]

    def advance(mv: np.ndarray) -> np.ndarray:
        x[0] = step(x[0], mv, plant.dv_nominal, p)
        return x[0]

    seen: list[tuple[str, float]] = []
    endpoint = SimulatedEndpoint(advance, pv=x[0], mv=[0.0, 2.0])
    loop = ControlLoop(Controller(file), endpoint, sp=[60.0], mv=[0.0, 2.0], clock=VirtualClock(), warm_lead_s=0.0)
    loop.run(40, before=lambda k: loop.set_mode(Mode.AUTO) if k == 20 else None,
             observe=lambda _, command: seen.append((command.mode.value, float(command.mv[1]))))  # fmt: skip
    assert seen == [("MANUAL", 2.0)] * 20 + [("AUTO", 1.0)] * 20
    assert x[0][1] > 45


def test_card_and_bench_know_allowed_values(file: Path) -> None:
    controller = Controller(file)
    text = card(controller)
    assert "  k_M   0 .. 1\n" in text
    assert "  mode  one of 1, 2\n" in text
    steps = iter(range(10_000))
    asked: list[np.ndarray] = []
    original = controller.step

    def recorded(**inputs: np.ndarray) -> object:
        next(steps)
        asked.append(np.array(inputs["mv_applied"]))
        return original(**inputs)

    controller.step = recorded  # type: ignore[assignment]
    assert len(bench(controller, steps=20, loop_steps=3, period_s=0.001)) == 3
    assert {float(mv[1]) for mv in asked} <= {1.0, 2.0}
    assert len({float(mv[0]) for mv in asked}) > 5


@pytest.fixture
def _elsewhere(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)


@pytest.mark.usefixtures("_elsewhere")
def test_simulate_shows_both_mvs_and_obeys_the_operator(file: Path, capsys: pytest.CaptureFixture[str]) -> None:
    asked = ["--from", "30", "--sp", "40", "--duration", "600", "--manual", "200..300=0.25,2", "--csv", "out.csv"]
    assert main(["simulate", str(file), *asked]) == 0
    with Path("out.csv").open(encoding="utf-8") as text:
        rows = list(csv.DictReader(text))
    assert {row["mode [-]"] for row in rows} == {"1", "2"}
    by_hand = [row for row in rows if row["mode"] == "MANUAL"]
    assert [(row["k_M [-]"], row["mode [-]"]) for row in by_hand] == [("0.25", "2")] * 10
    out = capsys.readouterr().out
    assert "changes of mode 2" in out
    assert "travel of k_M " in out
    assert Path("fuzzy_feedforward_observer-simulation.png").read_bytes().startswith(b"\x89PNG")


@pytest.mark.usefixtures("_elsewhere")
def test_a_scenario_with_a_plant_of_its_own_is_simulated_on_it(file: Path, capsys: pytest.CaptureFixture[str]) -> None:
    finals = []
    for scenario in ("profile", "same_model"):
        assert main(["simulate", str(file), "--scenario", scenario, "--duration", "3000", "--csv", "out.csv"]) == 0
        with Path("out.csv").open(encoding="utf-8") as text:
            finals.append(float(list(csv.DictReader(text))[-1]["T [degC]"]))
    assert abs(finals[0] - finals[1]) > 0.05
    assert main(["simulate", str(file), "--scenario", "same_model", "--disturbance", "b_hot_40=5@100"]) == 0
    assert "b_hot_40 = 5 degC" in capsys.readouterr().out


@pytest.mark.usefixtures("_elsewhere")
@pytest.mark.parametrize(
    ("span", "message"),
    [
        ("1..2=0.5,1.5", "manual mode = 1.5 is none of 1, 2"),
        ("1..2=1.5,1", "manual k_M = 1.5 is outside [0, 1]"),
        ("1..2=0.5", "manual has 1 value; plant 'jacketed_batch_reactor' has the MVs k_M, mode: give k_M,mode"),
        ("1..2=0.5,", "'' is no number"),
    ],
)
def test_a_manual_span_that_cannot_be_gives_one_line(
    file: Path, capsys: pytest.CaptureFixture[str], span: str, message: str
) -> None:
    try:
        status = main(["simulate", str(file), "--duration", "100", "--manual", span])
    except SystemExit as exit_:
        status = exit_.code
    error = capsys.readouterr().err
    assert status == 2
    assert message in error
    assert error.count("\n") == 1
