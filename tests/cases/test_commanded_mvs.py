"""What a controller may command, narrower and slower than what the record holds: tests, laws and the bound keep it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import yaml
from identified_models import scaled_model
from own_cases import GAINS, POLES, case_of, loop_of, section, two_lags

from loopwright.pipeline.cases.operating_range import visited_mv
from loopwright.pipeline.cases.own_plant import OwnCase, own_case
from loopwright.pipeline.errors import ParamsError
from loopwright.pipeline.evaluation.extrapolation import beyond
from loopwright.pipeline.laws import LAWS, ControlLaw
from loopwright.pipeline.models import load_model
from loopwright.pipeline.optimal.model_bounds import SampledHorizon, run_sampled
from loopwright.pipeline.records.record import Record
from loopwright.pipeline.simulation.scenario import Scenario
from loopwright.serving.manifest import Signal

LOW, HIGH, MOVE = -0.35, 0.15, 0.02  # of u0; the record visits -0.6 to 0.6
SETTINGS = {"predictive": {"horizon": 15, "moves": 4}, "pid": {"development_seeds": (1,), "development_set_points": 2}}


@pytest.fixture
def narrow(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> OwnCase:
    """Two lags whose first MV may be commanded over a part of its record, and at most MOVE a period of 1 s."""
    monkeypatch.chdir(tmp_path)
    two_lags()
    return limited(command_low=LOW, command_high=HIGH, max_move_per_min=60 * MOVE)


def limited(**limits: float) -> OwnCase:
    entry = section(2, 2)
    entry["mv"][0] |= limits
    Path("params.yaml").write_text(yaml.safe_dump({"plants": {"it": entry}, "cases": {}}))
    case = own_case("it")
    assert isinstance(case, OwnCase)
    return case


def designed(case: OwnCase, name: str) -> ControlLaw:
    law = LAWS[name]
    models = {"identified": load_model(case.models / "identified.npz")}
    return law.design(law.Params(**SETTINGS[name]), models, case.plant.signals, case.plant).eval()


def moves_of(law: ControlLaw, test: Scenario) -> np.ndarray:
    """All MVs (n + 1, n_mv) of a closed loop, the one before it first."""
    return np.vstack([test.mv0, loop_of(law, test).mv])


def nmpc_moves(_: OwnCase, test: Scenario) -> np.ndarray:
    kept: list[np.ndarray] = []

    def score(test: Scenario, pv: np.ndarray, mv: np.ndarray) -> dict[str, float]:
        kept.append(mv)
        return {"mae": float(np.abs(test.sp - pv).mean())}

    figures = run_sampled(SampledHorizon(test.plant, 12), test, score)  # type: ignore[arg-type]
    assert figures["failures"] == 0
    return np.vstack([test.mv0, kept[0]])


def test_the_record_is_read_whole_and_the_controller_has_the_range_to_command(narrow: OwnCase) -> None:
    u0, u1 = narrow.plant.mv_signals
    assert (u0.low, u0.high, u0.max_move) == (LOW, HIGH, pytest.approx(MOVE))
    assert (u1.low, u1.high, u1.max_move) == (-1.0, 1.0, None)
    assert [(s.low, s.high, s.max_move) for s in narrow.record_signals.mv] == [(-1.0, 1.0, None)] * 2
    assert narrow.record.mv[:, 0].min() < LOW < HIGH < narrow.record.mv[:, 0].max()
    assert designed(narrow, "predictive").signals.mv == (u0, u1)


def test_set_points_need_no_more_than_may_be_commanded(narrow: OwnCase) -> None:
    wide = limited()
    for case, low, high in ((narrow, LOW, HIGH), (wide, -0.6, 0.6)):
        tests = case.scenarios()["held_out"]
        needed = np.vstack([np.linalg.solve(GAINS, test.sp.T).T for test in tests])
        assert low - 1e-6 <= needed[:, 0].min() < needed[:, 0].max() <= high + 1e-6
        assert all(low < test.mv0[0] < high for test in tests)
    assert needed[:, 0].max() > HIGH + 0.1  # without the limits the same tests ask for more


@pytest.mark.parametrize("which", ["predictive", "pid", "nmpc"])
def test_laws_and_the_bound_keep_range_and_moves(narrow: OwnCase, which: str) -> None:
    law = None if which == "nmpc" else designed(narrow, which)
    for test in ("held_out", "spoilt"):
        sequence = narrow.scenarios()[test][0]
        mv = nmpc_moves(narrow, sequence) if law is None else moves_of(law, sequence)
        assert LOW - 1e-9 <= mv[:, 0].min() < mv[:, 0].max() <= HIGH + 1e-9
        moved = np.abs(np.diff(mv, axis=0)).max(axis=0)
        assert moved[0] == pytest.approx(MOVE, rel=1e-5)  # it would move faster
        assert moved[1] > 2 * MOVE  # the other MV has no limit


def test_a_median_that_may_not_be_commanded_gives_way_to_the_middle() -> None:
    mv = np.linspace(0.0, 100.0, 101)[:, None]
    signal = Signal("u", "%", 0.0, 100.0)
    record = Record(1.0, (), (signal,), (), np.zeros(101, int), np.arange(101.0), np.zeros((101, 0)), mv, mv[:, :0])

    def visited(low: float, high: float) -> list[float]:
        return visited_mv(record, (Signal("u", "%", low, high),))[:, 0].tolist()

    assert visited(0, 100) == pytest.approx([10, 50, 90])
    assert visited(20, 70) == pytest.approx([20, 50, 70])
    assert visited(60, 100) == pytest.approx([60, 75, 90])
    assert visited(90, 100) == pytest.approx([90, 95, 100])  # next to nothing visited


def test_tests_stay_in_the_record_where_the_models_rest_outside(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A load that nobody measured held the CVs where the models, under the median MVs, do not rest."""
    monkeypatch.chdir(tmp_path)
    case = two_lags()
    record = case.record
    models = [
        scaled_model(2, 2, 0, 2, a=np.diag(p), b=(1 - p)[:, None] * GAINS, c=(1 - p) * 1.5, rest=np.eye(2, 5))
        for p in POLES
    ]
    away = case_of(section(2, 2), models, 0.4 * record.pv, record.mv)
    low, high = np.quantile(away.record.pv, (0.01, 0.99), axis=0)
    assert np.any(away._model.measure(away._model.start[0]) > high)  # else this test tests nothing
    for name, tests in away.tests().items():
        for test in tests:
            assert np.all((test.sp >= low - 1e-9) & (test.sp <= high + 1e-9)), name
            assert test.plant is not None
            x, mv = test.plant.start
            assert test.plant.step(x, mv, test.plant.dv_nominal, test.plant.parameters()) == pytest.approx(x, abs=1e-6)
    held = away.scenarios()["held_out"][0]
    needed = np.linalg.solve(GAINS, (held.sp - 1.5).T)
    assert np.abs(needed).max() <= 1 + 1e-6  # and can be held
    assert np.ptp(held.sp, axis=0).min() > 0.2 * (high - low).min()
    asked = {s.name: (float(v.min()), float(v.max())) for s, v in zip(away.plant.sp_signals, held.sp.T, strict=True)}
    assert beyond(asked, away.recorded) == {}


@pytest.mark.parametrize(
    ("limits", "said"),
    [
        ({"command_low": -2.0}, "command_low is -2, outside low to high, -1 to 1"),
        ({"command_low": 0.5, "command_high": 0.2}, "command_low must be below command_high"),
        ({"max_move_per_min": 0.0}, "give a change above 0"),
        ({"max_move": 1.0}, "unknown key 'max_move'"),
    ],
)
def test_wrong_limits_are_one_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, limits: dict[str, float], said: str
) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(ParamsError, match=r"plants\.it") as error:
        limited(**limits)
    assert said in str(error.value)
