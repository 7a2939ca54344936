"""The last lines of a simulated run: MVs at their ends, travel, and what operators asked for."""

from __future__ import annotations

import re

import numpy as np
import pytest
from identified_models import made_signals

from loopwright.pipeline.laws.predictive.operating import entries_of
from loopwright.pipeline.pictures.loop_picture import History, drawn, summary
from loopwright.pipeline.pictures.operated_summary import operated_lines
from loopwright.serving.operating import Operate


class Plant:
    """A plant of which only the signals matter."""

    signals = made_signals(1, 2)
    sp_signals, pv_signals, mv_signals, period_s = signals.sp, signals.pv, signals.mv, 1.0


def said(error: float, mv: list[float]) -> str:
    n = 50
    history = History(
        [float(k) for k in range(n)],
        ["AUTO"] * n,
        [np.array([1.0])] * n,
        [np.array([1.0 + error])] * n,
        [np.array([1.0])] * n,
        [np.array(mv)] * n,
        [""] * n,
    )
    return summary(Plant(), history)  # type: ignore[arg-type]


def test_an_error_that_stays_names_the_mvs_at_their_ends() -> None:
    text = said(0.5, [1.0, 0.3])
    assert "an error stays with u0 at 1 V, an end of its range: these set points may be out of reach" in text
    assert "u1 at" not in text
    assert "u0 at -1 V and u1 at 1 V" in said(0.5, [-1.0, 1.0])


@pytest.mark.parametrize(("error", "mv"), [(0.0, [1.0, 0.0]), (0.5, [0.9, 0.0])])
def test_nothing_is_said_where_the_error_goes_or_the_mvs_have_room(error: float, mv: list[float]) -> None:
    assert "out of reach" not in said(error, mv)


# ------------------------------------------------------------------------------------------------- operators' changes
ENTRIES = entries_of(Plant.signals, 1, [], [], {})
N = 20


def steered(*changes: tuple[int, dict[str, float]], mv0: float = 0.0) -> History:
    """A PV that stands at 1, with a set point at 0, and MVs at .2 and .4; operators change something."""
    operate, now = [], Operate(ENTRIES).default
    for k in range(N):
        for at, values in changes:
            now = Operate(ENTRIES).with_values(values, now) if at == k else now
        operate.append(now)
    pv, mv = [np.array([1.0])] * N, [np.array([0.2, 0.4])] * N
    return History([float(k) for k in range(N)], ["AUTO"] * N, [np.array([0.0])] * N, pv, pv, mv, [""] * N,
                   np.array([mv0, 0.4]), ENTRIES, operate)  # fmt: skip


def lines(history: History, noise: float = 0.0) -> list[str]:
    return list(operated_lines(Plant(), history, np.array([noise])))  # type: ignore[arg-type]


def numbers(line: str) -> list[float]:
    return [float(n) for n in re.findall(r"(?<![a-z\d])-?\d+\.?\d*", line)]


def patches(history: History, plant: object) -> dict[str, set[str]]:
    """What each panel of the picture shows beside lines of every run, by the signal at its side."""
    figure = drawn(plant, history, "a run", {})  # type: ignore[arg-type]
    usual = {"set point", "controlled variable"}
    return {ax.get_ylabel().split(" ")[0]: {*ax.get_legend_handles_labels()[1]} - usual for ax in figure.axes}


def test_the_picture_shows_what_operators_asked_for() -> None:
    assert patches(steered(), Plant) == {"y0": set(), "u0": set(), "u1": set()}
    changed = (5, {"y0.track": 0, "y0.low": 0.5, "u0.rest": 0.1, "u0.rest_use": 1, "u1.use": 0, "u0.high": 0.9})
    assert patches(steered(changed), Plant) == {"y0": {"range"}, "u0": {"range", "resting value"}, "u1": {"out of use"}}
    line = next(of for of in drawn(Plant, steered(changed), "", {}).axes[0].lines if of.get_label() == "set point")  # type: ignore[arg-type]
    assert np.isnan(line.get_ydata()).tolist() == [False] * 5 + [True] * (N - 5)


class OfTwo(Plant):
    """A second PV without a set point."""

    signals = made_signals(2, 2)
    pv_signals = signals.pv


def test_the_picture_has_a_variable_that_has_a_range_alone() -> None:
    history = steered()
    history.pv = [np.array([1.0, 0.5])] * N
    assert set(patches(history, OfTwo)) == {"y0", "u0", "u1"}
    history.entries = entries_of(OfTwo.signals, 2, [], [], {"y1.high": 0.8})
    history.operate = [Operate(history.entries).default] * N
    assert patches(history, OfTwo) == {"y0": set(), "y1": {"range"}, "u0": set(), "u1": set()}


def test_the_first_move_counts_as_travel() -> None:
    for mv0, travel in ((0.2, 0.0), (-0.3, 0.5)):
        (line,) = [of for of in summary(Plant(), steered(mv0=mv0)).splitlines() if of.startswith("travel of u0")]  # type: ignore[arg-type]
        assert float(line.split()[3]) == pytest.approx(travel)


def test_errors_count_while_a_set_point_is_followed() -> None:
    def of(*changes: tuple[int, dict[str, float]]) -> list[str]:
        return [line for line in summary(Plant(), steered(*changes)).splitlines() if "y0" in line]  # type: ignore[arg-type]

    assert [line.startswith("MAE y0 1 m") for line in of()] == [True]
    let_go, error = of((5, {"y0.track": 0.0}))
    assert numbers(let_go)[-1] == 75
    assert error.startswith("MAE y0 1 m")
    assert len(of((0, {"y0.track": 0.0}))) == 1  # there is no error to be told


def test_nothing_is_said_of_a_law_without_operate_or_of_one_that_nobody_steered() -> None:
    plain = History([0.0], ["AUTO"], [np.zeros(1)], [np.ones(1)], [np.ones(1)], [np.zeros(2)], [""])
    assert lines(plain) == []
    assert lines(steered()) == []


def test_a_range_tells_its_time_outside_and_by_how_much_from_when_it_is_set() -> None:
    (line,) = lines(steered((0, {"y0.high": 2.0}), (15, {"y0.high": 0.6})))
    assert "25 % of the time" in line
    assert "0.4 m at most" in line
    assert "0 % of the time" in lines(steered((0, {"y0.high": 0.6})), noise=0.5)[0]  # noise may hide it
    assert lines(steered((0, {"y0.high": 0.6, "y0.use": 0.0}))) == []


def test_mvs_tell_limits_rests_and_uses_and_costs_a_profit() -> None:
    said = lines(
        steered((0, {"u0.high": 0.2, "u1.rest": 0.5, "u1.rest_use": 1.0}), (10, {"u1.use": 0.0, "u0.cost": 2.0}))
    )
    by_word = {line.split()[0]: line for line in said}
    assert "100 % of the time" in by_word["u0"]
    assert [line for line in said if "out of use for 50 %" in line]
    assert [line for line in said if "0.1 V from its resting value 0.5 V" in line]
    # Half of the run at .2 * 2 a period of 1 s.
    assert numbers(by_word["profit"]) == pytest.approx([-3600 * 0.2, -3600 * 0.4])
