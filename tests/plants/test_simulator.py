"""The contract of every simulator, and a user's own one from simulation to a trial of its controller."""

from __future__ import annotations

import pickle
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

import numpy as np
import pytest
from law_loops import stepper
from tank_simulator import Tanks

from loopwright.pipeline.__main__ import main
from loopwright.pipeline.cases import PLANTS
from loopwright.pipeline.errors import PlantError
from loopwright.pipeline.evaluation.case import Case
from loopwright.pipeline.evaluation.law_evidence import BASE
from loopwright.pipeline.evaluation.trials import try_files
from loopwright.pipeline.excitation import EXCITATIONS
from loopwright.pipeline.export.gate import export
from loopwright.pipeline.laws import LAWS
from loopwright.pipeline.metrics import mv_travel
from loopwright.pipeline.models.lagged.lagged import ArxPart
from loopwright.pipeline.models.local_models import LinearizedPart
from loopwright.pipeline.models.part import Source
from loopwright.pipeline.optimal.bounds import problem
from loopwright.pipeline.plants.simulator import Simulator
from loopwright.pipeline.simulation.scenario import Scenario, from_rest, held
from loopwright.pipeline.simulation.simulate import simulate_batch, simulate_closed, simulate_open
from loopwright.pipeline.tuning.reduction import start_lags
from loopwright.serving.manifest import Signal

PID = LAWS["pid"]
QUICK = {"development_seeds": (1, 2), "development_set_points": 2, "development_hold": 40}


@pytest.fixture(params=[*PLANTS.values(), Tanks], ids=lambda cls: cls.name)
def simulator(request: pytest.FixtureRequest) -> Simulator:
    made: Simulator = request.param()
    return made


def moves(plant: Simulator, *shape: int) -> np.ndarray:
    rng = np.random.default_rng(3)
    columns = [rng.choice(s.values, shape) if s.values else rng.uniform(s.low, s.high, shape) for s in plant.mv_signals]
    return np.stack(columns, axis=-1)


def test_the_contract_of_a_simulator(simulator: Simulator) -> None:
    """The faster forms equal step and measure; shapes; nothing is kept between steps; it survives pickling."""
    (x0, mv0), dv, p = simulator.start, simulator.dv_nominal, simulator.parameters()
    assert x0.shape == (simulator.n_x,)
    assert mv0.shape == (len(simulator.mv_signals),)
    assert p.shape == (len(simulator.parameter_names()),)
    advance, again = simulator.stepper(), pickle.loads(pickle.dumps(simulator))
    x, other = x0, x0
    for mv in moves(simulator, 12):
        expected = simulator.step(x, mv, dv, p)
        assert np.array_equal(simulator.step(x, mv, dv, p), expected)
        assert np.array_equal(advance(x, mv, dv, p), expected)
        assert np.array_equal(again.step(other, mv, dv, p), expected)
        x = other = expected
    assert x.shape == x0.shape
    assert np.isfinite(x).all()
    rows = np.stack([x0, x, 0.5 * (x0 + x)])
    pv = simulator.measured(rows.reshape(1, 3, -1))
    assert pv.shape == (1, 3, len(simulator.pv_signals))
    assert np.array_equal(pv[0], [simulator.measure(row) for row in rows])
    mvs = moves(simulator, 3)
    together = simulator.many(3)(rows, mvs)
    assert together == pytest.approx(np.array([simulator.step(a, b, dv, p) for a, b in zip(rows, mvs, strict=True)]))


def test_signals_are_the_plants(simulator: Simulator) -> None:
    of = simulator.signals
    assert (of.period_s, of.sp, of.pv) == (simulator.period_s, simulator.sp_signals, simulator.pv_signals)
    assert (of.dv, of.mv) == (simulator.dv_signals, simulator.mv_signals)


@dataclass(frozen=True)
class TanksCase(Case):
    """Set points up and down, and an outlet that clogs."""

    held_out_seeds: tuple[int, ...] = (5,)
    name: ClassVar[str] = "tanks"
    title: ClassVar[str] = "Two tanks"
    plant_class: ClassVar[type[Simulator]] = Tanks
    development_seeds: ClassVar[tuple[int, ...]] = (1,)
    noise: ClassVar[dict[str, float]] = {"h2": 0.005}
    gate: ClassVar[dict[str, float]] = {"steps": 1.0}

    def scenarios(self) -> dict[str, tuple[Scenario, ...]]:
        (x0, mv0), sp = self.plant.start, held([1.0, 2.0, 1.5], 100)
        clogged = {"k": np.where(np.arange(len(sp)) < 150, 0.5, 0.4)}
        return {
            "steps": (Scenario("steps", "Set points", sp, x0, mv0, hold=100),),
            "clogged": (Scenario("clogged", "The outlets clog", sp, x0, mv0, clogged, 100),),
        }

    def development(self) -> tuple[Scenario, ...]:
        return self.scenarios()["steps"]


def test_a_users_own_simulator_from_tuning_to_trial(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    plant, path = Tanks(), tmp_path / "pid.onnx"
    law = PID.design(PID.Params(**QUICK), {}, plant.signals, plant)
    export(law, path, case="tanks", provenance={})
    trial = try_files(TanksCase(), 0, [(BASE, 0, path)], "try")[0]
    assert trial.lock_ups == 0
    curves = trial.curves
    for name in ("steps", "clogged"):
        assert abs(curves[name].pv[-1, 0] - 1.5) < 0.01
    # Still at k = 0.5 until the outlets clog, and more than that from then on.
    assert np.array_equal(curves["steps"].pv[:151], curves["clogged"].pv[:151])
    assert np.abs(curves["steps"].pv[151:] - curves["clogged"].pv[151:]).max() > 0.02
    assert set(trial.metrics) == {"steps", "steps_noise", "clogged", "clogged_noise"}

    monkeypatch.chdir(tmp_path)
    monkeypatch.setitem(PLANTS, "tanks", Tanks)
    asked = ["--sp", "1.0", "--sp", "2.0@20", "--disturbance", "k=0.45@60", "--duration", "150"]
    assert main(["simulate", str(path), *asked, "--csv", "out.csv"]) == 0
    level = np.loadtxt("out.csv", delimiter=",", skiprows=1, usecols=3)
    assert level[0] == 1.0
    assert level[-1] == pytest.approx(2.0, abs=0.02)
    capsys.readouterr()
    assert main(["simulate", str(path), *asked, "--from", "1.2"]) == 2
    assert "equations" in capsys.readouterr().err


def test_records_and_models_of_a_users_own_simulator() -> None:
    plant = Tanks()
    record = EXCITATIONS["random_steps"](samples=400, low=0.3, high=0.7).run(plant, 0)
    assert np.array_equal(record.pv, simulate_open(plant, plant.start[0], record.mv)[:-1, 1:])
    learnt = ArxPart().learn(Source(record, plant.signals, regions=plant.regions))
    assert learnt.metrics["rmse"] < 0.05
    starts = np.array([[1.0, 1.0], [2.0, 0.5]])
    batch = simulate_batch(plant, starts, np.full((2, 5, 1), 0.6))
    for row, x0 in zip(batch, starts, strict=True):
        assert np.array_equal(row, simulate_open(plant, x0, np.full((5, 1), 0.6)))


def test_a_plant_without_equations_is_tuned_as_the_lags_at_its_start() -> None:
    """A dh/dt = ...: time constants 2 A sqrt(h) / k of both tanks, and gain 2 sqrt(h) / k from u to h2.

    The first Euler step of 0.1 s already moves h1 by its end: half a step less.
    """
    lags, dead_s = start_lags(Tanks())
    times_s = -1 / lags.eigenvalues.real
    assert -(lags.c @ np.linalg.solve(lags.a, lags.b))[0, 0] == pytest.approx(2 / 0.5, rel=1e-4)
    assert times_s.sum() + dead_s == pytest.approx(8.0 + 8.0 - 0.05, rel=1e-4)
    assert 0 <= dead_s < 0.1
    assert times_s == pytest.approx([8.0, 8.0], rel=0.1)


class OneTank(Tanks):
    """The second tank alone."""

    def step(self, x: np.ndarray, mv: np.ndarray, dv: np.ndarray, p: np.ndarray) -> np.ndarray:
        return np.array([1.0, x[1] + (1 - np.exp(-0.125)) * (4 * (mv[0] - 0.5) + 1 - x[1])])


def test_a_plant_of_one_lag_is_that_lag() -> None:
    lag, dead_s = start_lags(OneTank())
    assert lag.a == pytest.approx(np.array([[-0.125]]), rel=2e-3)
    assert lag.b == pytest.approx(np.array([[0.5]]), rel=2e-3)
    assert dead_s < 0.1


class Piped(Simulator):
    """A lag of gain 2 and 30 samples behind a pipe of 12, both from rest at 0, of any number of lags in a row."""

    name = "piped"
    title = "A lag behind a pipe"
    pv_signals = sp_signals = (Signal("T", "K", -10.0, 10.0),)
    mv_signals = (Signal("u", "%", -5.0, 5.0),)
    period_s = 2.0
    pipe, lags, tau_s = 12, 1, 60.0

    @property
    def start(self) -> tuple[np.ndarray, np.ndarray]:
        return np.zeros(self.pipe + self.lags), np.zeros(1)

    def step(self, x: np.ndarray, mv: np.ndarray, dv: np.ndarray, p: np.ndarray) -> np.ndarray:
        line, chain = np.concatenate([mv, x[: self.pipe]]), x[self.pipe :]
        into, keep = np.concatenate([2 * line[-1:], chain[:-1]]), np.exp(-self.period_s / self.tau_s)
        return np.concatenate([line[:-1], keep * chain + (1 - keep) * into])

    def measure(self, x: np.ndarray) -> np.ndarray:
        return x[-1:]


class Chain(Piped):
    """Five lags of 30 samples, without a pipe."""

    pipe, lags = 0, 5


class TwoLags(Piped):
    """Two lags behind the pipe."""

    lags = 2


class Cells(Piped):
    """Five cells of 4.8 s in the pipe's place, whose outflow shows a little at once."""

    pipe, lags = 0, 6

    def step(self, x: np.ndarray, mv: np.ndarray, dv: np.ndarray, p: np.ndarray) -> np.ndarray:
        keep = np.exp(-self.period_s / np.array([4.8] * 5 + [60.0]))
        return keep * x + (1 - keep) * np.concatenate([2 * mv, x[:-1]])


class Leaking(Piped):
    """A hundred-thousandth of the MV goes past the pipe."""

    def step(self, x: np.ndarray, mv: np.ndarray, dv: np.ndarray, p: np.ndarray) -> np.ndarray:
        after = super().step(x, mv, dv, p)
        return np.concatenate([after[:-1], after[-1:] + 1e-5 * mv])


class Against(Piped):
    """Gain -2, a dead time of two samples and a half."""

    pipe = 3

    def step(self, x: np.ndarray, mv: np.ndarray, dv: np.ndarray, p: np.ndarray) -> np.ndarray:
        into, keep = -(x[1] + x[2]), np.exp(-self.period_s / self.tau_s)
        return np.concatenate([mv, x[:2], keep * x[3:] + (1 - keep) * into])


class PipeAlone(Piped):
    """Twenty samples, and no lag to speak of."""

    pipe, tau_s = 20, 0.1


class Swinging(Piped):
    """A swing of 0.1 rad/s with half of the critical damping, and no dead time."""

    pipe, lags, period_s, damping = 0, 2, 1.0, 0.5

    def step(self, x: np.ndarray, mv: np.ndarray, dv: np.ndarray, p: np.ndarray) -> np.ndarray:
        for _ in range(100):
            x = x + 0.01 * np.array([x[1], 0.01 * (mv[0] - x[0]) - 0.2 * self.damping * x[1]])
        return x

    def measure(self, x: np.ndarray) -> np.ndarray:
        return x[:1]


def test_a_dead_time_is_no_lag() -> None:
    """A pipe of 12 samples of 2 s; a lag that is sampled counts half a period less."""
    lag, dead_s = start_lags(Piped())
    assert lag.a == pytest.approx(np.array([[-1 / 60.0]]), rel=1e-2)
    assert dead_s == pytest.approx(24.0, abs=1.0)
    lags, dead_s = start_lags(TwoLags())
    assert -1 / lags.eigenvalues.real == pytest.approx([60.0, 60.0], rel=0.15)
    assert dead_s == pytest.approx(24.0, abs=2.0)
    lags, dead_s = start_lags(Chain())
    assert (-1 / lags.eigenvalues.real).sum() + dead_s == pytest.approx(300.0, rel=0.03)
    assert dead_s > 60.0
    for plant, wanted in ((Leaking(), 24.0), (Against(), 5.0), (PipeAlone(), 40.0)):
        lag, dead_s = start_lags(plant)
        assert dead_s == pytest.approx(wanted, abs=1.1)
        assert len(lag.eigenvalues) == 1
    lags, dead_s = start_lags(Cells())
    assert max(-1 / lags.eigenvalues.real) == pytest.approx(60.0, rel=0.02)
    assert 15.0 < dead_s < 24.0


def test_what_has_no_dead_time_gets_none() -> None:
    """Neither by sampling or a difference's error, nor because it swings or overshoots at once."""
    for plant in (OneTank(), Swinging()):
        assert start_lags(plant)[1] == 0.0


@pytest.mark.parametrize("tuning", ["imc", "simc"])
@pytest.mark.parametrize("plant", [PipeAlone(), Swinging()], ids=lambda p: type(p).__name__)
def test_a_rules_pid_settles_what_is_no_lag(plant: Simulator, tuning: str) -> None:
    law = PID.design(PID.Params(tuning=tuning), {}, plant.signals, plant)
    loop = simulate_closed(plant, stepper(law), Scenario("step", "", held([1.0], 600), *plant.start))
    assert loop.pv[-1, 0] == pytest.approx(1.0, abs=0.02)
    assert loop.pv.max() < 1.5


@pytest.mark.parametrize("tuning", ["imc", "simc", "itae"])
@pytest.mark.parametrize(
    "plant", [Piped(), TwoLags(), Chain(), Cells(), Leaking(), Against()], ids=lambda p: type(p).__name__
)
def test_a_rules_pid_settles_a_plant_with_dead_time(plant: Simulator, tuning: str) -> None:
    """Within twenty lags, without more than a few swings: the MV travels little more than its change."""
    law = PID.design(PID.Params(tuning=tuning), {}, plant.signals, plant)
    loop = simulate_closed(plant, stepper(law), Scenario("step", "", held([1.0], 600), *plant.start))
    assert loop.pv[-1, 0] == pytest.approx(1.0, abs=0.02)
    assert loop.pv.max() < 1.5
    assert mv_travel(loop.mv) < 6.0


class AtItsLimit(OneTank):
    """Starts with its valve as far open as it goes."""

    mv_signals = (Signal("u", "m3/s", 0.0, 0.5),)

    def step(self, x: np.ndarray, mv: np.ndarray, dv: np.ndarray, p: np.ndarray) -> np.ndarray:
        return super().step(x, np.minimum(mv, 0.5), dv, p)


def test_a_start_at_an_end_of_the_mvs_range_is_differenced_on_one_side() -> None:
    assert start_lags(AtItsLimit())[0].b == pytest.approx(start_lags(OneTank())[0].b, rel=1e-6)


class Restless(Tanks):
    """Starts in the middle of a rise."""

    @property
    def start(self) -> tuple[np.ndarray, np.ndarray]:
        return np.ones(2), np.array([1.0])


class Filling(Tanks):
    """Nothing flows out: the level only rises."""

    def step(self, x: np.ndarray, mv: np.ndarray, dv: np.ndarray, p: np.ndarray) -> np.ndarray:
        return x + 0.1 * (mv[0] - self.k)


def test_what_needs_equations_says_so() -> None:
    plant = Tanks()
    law = PID.design(PID.Params(tuning="manual", kc=0.3, ti_s=10.0, examined_cv=(0.6, 2.0)), {}, plant.signals, None)
    asked = {
        "the stability of a law's linear loops": lambda: law.analysis(plant),
        "a linearized part": lambda: LinearizedPart(at=1.0).learn(Source(None, plant.signals, plant=plant)),
        "a part without a plant": lambda: LinearizedPart(at=1.0).learn(Source(None, plant.signals)),
        "a start at a steady state": lambda: from_rest(plant, "test", "", held([1.0], 5)),
        "bounds": lambda: problem(TanksCase()),
        "a tuning at another point": lambda: PID.design(
            PID.Params(tuning="imc", operating_cv=2.0), {}, plant.signals, plant
        ),
    }
    for ask in asked.values():
        with pytest.raises(PlantError, match=r"needs a plant's equations.*EquationPlant"):
            ask()
    with pytest.raises(PlantError, match="not at rest at its start"):
        PID.design(PID.Params(tuning="imc"), {}, plant.signals, Restless())
    with pytest.raises(PlantError, match="not stable at its start"):
        PID.design(PID.Params(tuning="imc"), {}, plant.signals, Filling())
    with pytest.raises(PlantError, match="has no parameter 'K'; it has area, k"):
        plant.parameters({"K": 1.0})
