"""The largest change of each MV: of the plant's signal, of the law's own ``mv_rate``, and what a file says of it."""

from __future__ import annotations

from dataclasses import replace
from math import inf
from pathlib import Path

import numpy as np
import pytest
from identified_models import made_signals, random_model
from predictive_loops import closed

from loopwright.pipeline.config.params import parse
from loopwright.pipeline.errors import LawError, ParamsError
from loopwright.pipeline.export.gate import export
from loopwright.pipeline.laws.base import Rates, rates_of
from loopwright.pipeline.laws.pid.pid import PID
from loopwright.pipeline.laws.predictive.predictive import Predictive
from loopwright.pipeline.plants.simulator import Signals
from loopwright.serving.card import card
from loopwright.serving.controller import Controller
from loopwright.serving.operating import Operate


def slow(*moves: float | None) -> Signals:
    signals = made_signals(n_y=2, n_mv=2)
    return replace(signals, mv=tuple(replace(s, max_move=m) for s, m in zip(signals.mv, moves, strict=True)))


@pytest.mark.parametrize(
    ("moves", "mv_rate", "wanted"),
    [
        ((None, None), None, None),
        ((None, None), 0.2, (0.2, 0.2)),
        ((None, None), (0.2, None), (0.2, inf)),
        ((0.1, None), None, (0.1, inf)),
        ((0.1, None), 0.2, (0.1, 0.2)),
        ((0.1, 0.3), (0.05, 0.4), (0.05, 0.3)),
    ],
)
def test_the_lesser_limit_counts(
    moves: tuple[float | None, ...], mv_rate: Rates, wanted: tuple[float, ...] | None
) -> None:
    assert rates_of(slow(*moves), mv_rate) == wanted


def test_a_wrong_number_of_rates_is_one_line() -> None:
    with pytest.raises(LawError, match=r"1 entries; give one number for all MVs, or one for each \(u0, u1\)"):
        rates_of(slow(None, None), (0.1,))
    with pytest.raises(LawError, match=r"mv_rate is \[0.1, 0.0\]"):
        rates_of(slow(None, None), (0.1, 0.0))
    with pytest.raises(ParamsError, match="mv_rate"):
        parse(Predictive.Params, {"mv_rate": "fast"}, "controllers.x")


@pytest.mark.parametrize("law", [PID, Predictive])
def test_params_yaml_takes_one_number_or_one_for_each_mv(law: type[PID | Predictive]) -> None:
    for given, read in ((5, 5.0), ([5, None], (5.0, None)), (None, None)):
        assert parse(law.Params, {"mv_rate": given}, "controllers.x").mv_rate == read


def test_a_file_keeps_the_limit_of_one_mv_and_says_it(tmp_path: Path) -> None:
    signals = slow(0.05, None)
    law = Predictive(signals, random_model(2, n_y=2, n_mv=2), Predictive.Params(horizon=8, moves=2, passes=1)).eval()
    assert law.rate is not None
    assert law.rate.tolist() == [0.05, 4.0]  # twice the range: no limit
    manifest = export(law, tmp_path / "law.onnx", case="made", provenance={})
    assert [s.max_move for s in manifest.mv] == [0.05, None]
    controller, mv = Controller(tmp_path / "law.onnx"), np.zeros(2)
    assert "  u0  -1 .. 1 V, moves at most 0.05 V a period (1 s)\n  u1  -1 .. 1 V\n" in card(controller)
    state, moved = controller.cold_state(), np.zeros(2)
    for k in range(20):
        sp = np.array([2.0, -2.0]) * (-1) ** (k // 5)
        before = mv
        mv, state, _ = controller.step(sp=sp, pv=np.zeros(2), dv=np.zeros(0), mv_applied=mv, state=state)
        moved = np.maximum(moved, np.abs(mv - before))
    assert moved[0] == pytest.approx(0.05)
    assert moved[1] > 0.1


@pytest.mark.parametrize("max_move", [None, 0.3])
def test_a_rate_of_the_law_is_planned_with_and_the_most_that_operators_may_give(max_move: float | None) -> None:
    signals, model = made_signals(2, 2), random_model(1, n_y=2, n_mv=2)
    signals = replace(signals, mv=tuple(replace(s, max_move=max_move) for s in signals.mv))
    as_plant = replace(signals, mv=tuple(replace(s, max_move=r) for s, r in zip(signals.mv, (0.05, 0.1), strict=True)))
    params = Predictive.Params(horizon=20, operate={})
    of_law, of_plant = (
        Predictive(given, model, p).eval()
        for given, p in ((signals, replace(params, mv_rate=(0.05, 0.1))), (as_plant, params))
    )
    sp = np.full((30, 2), 0.4)
    for one, other in zip(closed(of_law, model, sp), closed(of_plant, model, sp), strict=True):
        np.testing.assert_array_equal(one, other)
    operate = Operate(of_law.operate)
    assert [operate.entries[operate.places[f"{s.name}.max_move"]].high for s in signals.mv] == [0.05, 0.1]
    with pytest.raises(LawError, match="max_move"):
        Predictive.check_settings(
            replace(params, mv_rate=0.05, operate={f"{signals.mv[0].name}.max_move": 0.2}), signals
        )
