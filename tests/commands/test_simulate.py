"""``loopwright simulate``: what is asked for happens, and what cannot be is told in one line."""

from __future__ import annotations

import csv
import io
import subprocess
import sys
from contextlib import nullcontext
from itertools import pairwise
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import pytest
from identified_models import parts
from rich.console import Console
from rich.live import Live

from loopwright.pipeline import commands
from loopwright.pipeline.__main__ import main
from loopwright.pipeline.cases import CASES
from loopwright.pipeline.engine.run_mark import run_marked
from loopwright.pipeline.errors import PlantError
from loopwright.pipeline.export.gate import export
from loopwright.pipeline.laws import LAWS
from loopwright.pipeline.laws.predictive.predictive import Predictive
from loopwright.pipeline.metrics import mae
from loopwright.pipeline.plants.equations import EquationPlant
from loopwright.pipeline.simulation.live import SimulatedPlant, TerminalView, sparkline
from loopwright.pipeline.simulation.simulate import simulate_closed
from loopwright.serving import Controller, Mode, VirtualClock

CASE = "thiosulfate_cstr"
pytest_plugins = ["small_laws"]


@pytest.fixture(scope="session")
def pid_file(plant: EquationPlant, tmp_path_factory: pytest.TempPathFactory) -> Path:
    cls = LAWS["pid"]
    params = cls.Params(tuning="imc", lambda_s=1.6, operating_cv=0.66613)
    path = tmp_path_factory.mktemp("controllers") / "pid.onnx"
    export(cls.design(params, {}, plant.signals, plant), path, case=CASE, provenance={})
    return path


@pytest.fixture(autouse=True)
def _in_a_folder_of_its_own(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)


def simulate(file: Path, *options: str) -> list[dict[str, str]]:
    """Run and return the samples."""
    assert main(["simulate", str(file), "--csv", "out.csv", *options]) == 0
    with Path("out.csv").open(encoding="utf-8") as text:
        return list(csv.DictReader(text))


def column(rows: list[dict[str, str]], name: str) -> np.ndarray:
    return np.array([float(row[name]) for row in rows])


def test_a_scenario_is_the_one_that_validation_runs(pid_file: Path, plant: EquationPlant) -> None:
    """The loop, its guards and modes add nothing: the same trajectory as the bare controller's."""
    rows = simulate(pid_file, "--scenario", "sp_b")
    (scenario,) = CASES[CASE].scenarios()["sp_b"]
    controller = Controller(pid_file)
    state = [controller.cold_state()]

    def step(sp: np.ndarray, pv: np.ndarray, mv: np.ndarray) -> Any:
        result = controller.step(sp=sp, pv=pv, mv_applied=mv, state=state[0])
        state[0] = result.state
        return result.mv, result.info

    expected = simulate_closed(plant, step, scenario)
    np.testing.assert_allclose(column(rows, "C_A [mol/l]"), expected.pv[:, 0], rtol=1e-6)
    np.testing.assert_allclose(column(rows, "T_j [K]"), expected.mv[:, 0], rtol=1e-6, atol=1e-4)


@pytest.fixture(scope="session")
def steered_file(plant: EquationPlant, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A predictive law of the case that reads what operators change."""
    path, model = tmp_path_factory.mktemp("controllers") / "steered.onnx", parts(plant)["identified"]
    law = Predictive(plant.signals, model, Predictive.Params(horizon=20, operate={})).eval()
    export(law, path, case=CASE, provenance={})
    return path


def test_a_simulation_has_the_operate_that_is_asked_for(
    steered_file: Path, pid_file: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    def highest(*options: str) -> float:
        return float(column(simulate(steered_file, "--sp", "0.5", "--duration", "20", *options), "T_j [K]").max())

    assert highest() > 300
    assert highest("--operate", "T_j.high=280", "--operate", "speed=2") == 280
    assert highest("--operate", "T_j.use=false") == highest("--operate", "T_j.use=0") < 300
    twice = ("T_j.high=280", "--operate", "T_j.high=290")
    for file, value in (
        (steered_file, ("T_j.high=900",)), (steered_file, ("T_j.top=1",)), (pid_file, ("T_j.high=280",)),
        (steered_file, twice), (steered_file, ("T_j.high=900@5",)), (pid_file, ("T_j.high=280@5",)),
        (steered_file, ("T_j.high=true",)),
    ):  # fmt: skip
        capsys.readouterr()
        assert main(["simulate", str(file), "--sp", "0.5", "--operate", *value]) == 2
        said = capsys.readouterr().err
        assert said.startswith("loopwright simulate: ")
        assert "operate" in said
        assert said.count("\n") == 1


def test_a_course_is_known_before_it_comes(
    plant: EquationPlant, pid_file: Path, tmp_path_factory: pytest.TempPathFactory, capsys: pytest.CaptureFixture[str]
) -> None:
    """The set point follows the file, and the MV of a law that reads it moves before it does."""
    path, model = tmp_path_factory.mktemp("controllers") / "course.onnx", parts(plant)["identified"]
    law = Predictive(plant.signals, model, Predictive.Params(horizon=20, preview="course")).eval()
    export(law, path, case=CASE, provenance={})
    Path("recipe.csv").write_text("time,C_A\n10,0.6\n15,0.55\n")
    plain = simulate(path, "--sp", "0.5", "--duration", "20")
    rows = simulate(path, "--sp", "0.5", "--duration", "20", "--course", "recipe.csv")
    np.testing.assert_array_equal(column(rows, "SP C_A [mol/l]"), np.repeat([0.5, 0.6, 0.55], [20, 10, 10]))
    moved = np.abs(column(rows, "T_j [K]") - column(plain, "T_j [K]"))
    assert moved[:20].max() > 0.1
    for words in ([str(pid_file), "--course", "recipe.csv"], [str(path), "--straight", "C_A"]):
        capsys.readouterr()
        assert main(["simulate", *words, "--sp", "0.5", "--duration", "20"]) == 2
        assert capsys.readouterr().err.count("\n") == 1


def test_operators_change_something_while_it_runs(steered_file: Path, capsys: pytest.CaptureFixture[str]) -> None:
    plain = simulate(steered_file, "--sp", "0.5", "--duration", "40")
    capsys.readouterr()
    changed = ("T_j.high=280@10", "C_A.track=0@20", "C_A.low=0.6@20", "T_j.cost=1@20")
    options = [word for value in changed for word in ("--operate", value)]
    rows = simulate(steered_file, "--sp", "0.5", "--duration", "40", *options)
    before = column(rows, "time_s") < 10
    mv, usual = column(rows, "T_j [K]"), column(plain, "T_j [K]")
    assert mv[before].tolist() == usual[before].tolist()
    assert mv[~before].max() <= 280 < usual[~before].max()
    out = capsys.readouterr().out
    lines = [line for line in out.splitlines() if line.startswith(("C_A follows", "C_A outside", "T_j at", "profit "))]
    assert [line.split()[0] for line in lines] == ["C_A", "C_A", "T_j", "profit"]
    assert "50 %" in lines[0]
    assert "outside 0.6" in lines[1]


def test_set_points_disturbance_and_manual_happen_when_asked(
    pid_file: Path, plant: EquationPlant, capsys: pytest.CaptureFixture[str]
) -> None:
    rows = simulate(
        pid_file, "--from", "0.6", "--sp", "0.7@5", "--sp", "0.65@30", "--disturbance", "T_in=285@60",
        "--manual", "80..81.5=240", "--duration", "90",
    )  # fmt: skip
    assert len(rows) == 180
    sp, mv = column(rows, "SP C_A [mol/l]"), column(rows, "T_j [K]")
    np.testing.assert_array_equal(sp, np.repeat([0.6, 0.7, 0.65], [10, 50, 120]))
    _, steady = plant.steady_state_at(0.6)
    np.testing.assert_allclose(mv[:10], steady[0], rtol=1e-6)  # at rest until the set point moves
    assert [row["mode"] for row in rows] == ["AUTO"] * 160 + ["MANUAL"] * 3 + ["AUTO"] * 17
    assert set(mv[160:163]) == {240.0}
    cv = column(rows, "C_A [mol/l]")
    assert abs(cv[120] - 0.65) < 1e-2 < np.ptp(cv[120:160])
    out = capsys.readouterr().out
    assert f"MAE C_A {mae(sp, cv):.4g} mol/l" in out
    assert "T_in = 285 K" in out
    assert Path("pid-simulation.png").read_bytes().startswith(b"\x89PNG")


def test_noise_has_its_seed_and_its_size(pid_file: Path) -> None:
    asked = ("--sp", "0.5", "--noise", "C_A=5e-4", "--noise", "T=0.1", "--duration", "150")
    first, again, other = (simulate(pid_file, *asked, "--seed", seed) for seed in ("1", "1", "2"))
    assert first == again != other
    for name, std in (("C_A [mol/l]", 5e-4), ("T [K]", 0.1)):
        noise = column(first, f"measured {name}") - column(first, name)
        assert np.std(noise) == pytest.approx(std, rel=0.15)


def test_a_fault_is_shown_and_recovered_from(pid_file: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Noise beyond the sensor's range: the loop holds, and goes on when the sensor is back."""
    rows = simulate(pid_file, "--from", "0.95", "--sp", "0.9", "--noise", "C_A=0.05", "--duration", "200")
    held = [k for k, row in enumerate(rows) if row["mode"] == "HOLD"]
    assert held
    for k in held:
        if rows[k - 1]["mode"] == "HOLD":
            assert rows[k]["T_j [K]"] == rows[k - 1]["T_j [K]"]
    assert rows[held[-1]]["reason"].startswith("PV C_A is ")
    assert f"{len(held)} scans with a fault, the last one: PV C_A" in capsys.readouterr().out


class Watched(VirtualClock):
    """The machine's clock in a test's hands: it keeps the speed, and sleeps for ``late_s`` [s] too long, once."""

    made: ClassVar[list[Watched]] = []
    late_s = 0.0

    def __init__(self, speed: float) -> None:
        super().__init__(100.0)
        self.speed, self.late_at = speed, 104.0
        self.made.append(self)

    def sleep_until(self, time_s: float) -> None:
        super().sleep_until(time_s)
        if self.late_s and time_s >= self.late_at:
            self.advance(self.late_s)
            self.late_at = np.inf


def test_real_time_takes_its_time_and_gives_the_same(pid_file: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(commands.simulate, "MonotonicClock", Watched)
    monkeypatch.setattr(Watched, "made", [])
    asked = ("--sp", "0.6", "--duration", "25")
    fast = simulate(pid_file, *asked)
    assert not Watched.made
    assert simulate(pid_file, *asked, "--speed", "250") == fast
    (clock,) = Watched.made
    assert clock.speed == 250
    assert clock.now() - 100.0 == pytest.approx(float(fast[-1]["time_s"]))  # seconds of the plant


def test_the_plant_goes_on_in_periods_that_a_slow_machine_missed(
    pid_file: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """0.5 s a period: a scan that comes 1.2 s late misses two, and finds the plant of its own time."""
    monkeypatch.setattr(commands.simulate, "MonotonicClock", Watched)
    asked = ("--sp", "0.6", "--duration", "25")
    fast = simulate(pid_file, *asked)
    monkeypatch.setattr(Watched, "late_s", 1.2)
    timed = simulate(pid_file, *asked, "--speed", "250")
    times = [float(row["time_s"]) for row in timed]
    late = next(k for k, (last, now) in enumerate(pairwise(times), 1) if now - last > 0.6)
    assert timed[:late] == fast[:late]
    assert np.isclose(times[late] - times[late - 1], 1.5)
    assert times[late:] == [float(row["time_s"]) for row in fast[late + 2 :]]
    held = simulate(pid_file, *asked, "--manual", f"{times[late] - 1.0:g}..{times[late]:g}")
    assert timed[late]["C_A [mol/l]"] == held[late + 2]["C_A [mol/l]"]  # the MV was held in the meantime


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--sp", "high"], "argument --sp: 'high' is no number; the form is [NAME=]VALUE[@S]"),
        (["--sp", "0.5@-1"], "must not be negative"),
        (["--sp", "1.5"], "set point C_A = 1.5 mol/l is outside [0, 1] mol/l"),
        (["--sp", "0.5@900", "--duration", "10"], "time 900 s lies beyond the run, which ends at 10 s"),
        (["--sp", "0.5", "--scenario", "sp_a"], "not both"),
        (["--scenario", "sp_c"], "did you mean 'sp_"),
        (["--sp", "0.5", "--from", "1.2"], "a start at C_A = 1.2 mol/l is outside [0, 1] mol/l"),
        (["--sp", "0.5", "--manual", "20..30", "--duration", "10"], "manual from 20 s lies beyond the run"),
        (["--disturbance", "UA"], "'UA' is not of the form NAME=VALUE[@S]"),
        (["--disturbance", "T_inn=3"], "has no parameter 'T_inn'; did you mean 'T_in'?"),
        (["--noise", "CA=1"], "has no process variable 'CA'; did you mean 'C_A'?"),
        (["--noise", "T"], "'T' is not of the form PV=STD"),
        (["--noise", "T=0.1@30"], "'T=0.1@30' is not of the form PV=STD"),
        (["--noise", "C_A=-1"], "the noise of C_A is -1; a standard deviation is 0 or above"),
        (["--noise", "C_A=nan"], "not finite"),
        (["--manual", "9..3"], "end after that"),
        (["--manual", "3..9=900"], "manual T_j = 900 K is outside [0, 500] K"),
        (["--duration", "0"], "'0' is not allowed; give a number above 0 [s]"),
        (["--speed", "fast"], "'fast' is not allowed; give a number above 0"),
        (["--picture", "/dev/null/x.png"], "/dev/null/x.png cannot be written"),
        (["--picture", "x.docx"], "cannot be written: Format 'docx' is not supported"),
        (["--nose", "C_A=1"], "unrecognized arguments"),
    ],
)
def test_bad_options_give_one_line(
    pid_file: Path, capsys: pytest.CaptureFixture[str], options: list[str], message: str
) -> None:
    try:
        status = main(["simulate", str(pid_file), "--duration", "5", *options])
    except SystemExit as exit_:
        status = exit_.code
    assert status == 2
    error = capsys.readouterr().err
    assert message in error
    assert error.count("\n") == 1


def test_a_plant_that_leaves_its_equations_ends_the_simulation(
    pid_file: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """The loop outlives an endpoint that raises; the command must say why and end."""
    writes: list[int] = []

    def write(self: SimulatedPlant, mv: np.ndarray) -> None:
        writes.append(self.k)
        raise PlantError("the plant has left what its equations can compute")

    monkeypatch.setattr(SimulatedPlant, "write", write)
    assert main(["simulate", str(pid_file), "--sp", "0.6", "--duration", "25"]) == 2
    assert capsys.readouterr().err == ("loopwright simulate: the plant has left what its equations can compute\n")
    assert writes == [0]


def test_a_controller_of_another_plant_is_refused(
    pi_file: Path, pid_file: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["simulate", str(pi_file)]) == 2
    assert "for 'tank', which is neither a case nor a plant" in capsys.readouterr().err
    assert main(["simulate", str(pid_file.with_suffix(".json"))]) == 2
    assert "not a controller" in capsys.readouterr().err


def test_as_a_program(pid_file: Path) -> None:
    def run(*arguments: str) -> subprocess.CompletedProcess[str]:
        command = [sys.executable, "-W", "error", "-m", "loopwright.pipeline", *arguments]
        return subprocess.run(command, capture_output=True, text=True, timeout=60)

    done = run("simulate", str(pid_file), "--sp", "0.6", "--duration", "10", "--picture", "loop.svg")
    assert (done.returncode, done.stderr) == (0, "")
    assert done.stdout.splitlines()[-1] == "picture: loop.svg"
    assert Path("loop.svg").exists()
    failed = run("simulate", "none.onnx")
    assert failed.returncode == 2
    assert failed.stderr == ("loopwright simulate: none.onnx: the file cannot be read: No such file or directory\n")
    assert "simulate" in run().stdout


def test_the_live_view_shows_mode_values_and_faults(plant: EquationPlant) -> None:
    console = Console(file=io.StringIO(), force_terminal=True, width=120, height=30)
    with Live(console=console, auto_refresh=False) as live:
        view = TerminalView(plant, "pid", 10.0, live)
        for k in range(20):
            mode, reason = (Mode.HOLD, "PV C_A is nan") if k > 10 else (Mode.AUTO, "")
            view.show(k * 0.5, mode.value, np.array([0.5, 0.4, 310.0, 250.0 + k]), reason, "UA = 1" if k == 3 else None)
    text = console.file.getvalue()  # type: ignore[attr-defined]
    for part in ("HOLD", "SP C_A", "269", "1.5 s  UA = 1", "5.5 s  fault: PV C_A is nan", "9.5 of 10.0 s"):
        assert part in text


def test_sparkline() -> None:
    assert sparkline(np.linspace(0, 1, 8), 0, 1) == "▁▂▃▄▅▆▇█"
    assert sparkline(np.array([-9.0, 9.0, np.nan]), 0, 1) == "▁█▁"
    assert len(sparkline(np.zeros(500), 0, 1, width=60)) == 60


@pytest.mark.parametrize(("given", "under_way"), [("mill", False), ("mill", True), ("artifacts/mill/pid.onnx", True)])
def test_a_controller_that_no_run_has_made_yet_is_told_with_the_run_that_makes_it(
    given: str, under_way: bool, capsys: pytest.CaptureFixture[str]
) -> None:
    Path("params.yaml").write_text("cases: {mill: {}}\n")
    with run_marked() if under_way else nullcontext():
        assert main(["simulate", given]) == 2
    said = capsys.readouterr().err
    assert ("a run is under way" in said) is under_way
    assert ("`loopwright run mill`" in said) is not under_way
    assert len(said.splitlines()) == 1
