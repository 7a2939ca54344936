"""The predictive law that reads what is to come: set points and measured disturbances over its horizon."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from identified_models import first_order, made_signals, random_model
from predictive_loops import NONE, law_of, row
from torch import Tensor

from loopwright.pipeline.config.params import parse
from loopwright.pipeline.errors import ParamsError
from loopwright.pipeline.laws.predictive.disturbance_model import loads_of
from loopwright.pipeline.laws.predictive.horizon import Moves, horizon_of
from loopwright.pipeline.laws.predictive.predictive import Predictive
from loopwright.pipeline.models.identified.identified import Identified

N = 12
COURSE = {"horizon": N, "preview": "course"}


def stepped(law: Predictive, n: int, ahead: Tensor | None, seed: int = 0) -> list[Tensor]:
    """All outputs of a law over random inputs."""
    rng, signals = np.random.default_rng(seed), law.signals
    state, mv, found = torch.zeros(law.n_state).double(), torch.zeros(len(signals.mv)).double(), []
    more: list[Any] = [] if law.ahead is None or ahead is None else [None, None, ahead]
    with torch.no_grad():
        for _ in range(n):
            sp, pv, dv = (
                torch.from_numpy(0.5 * rng.normal(size=len(of))) for of in (signals.sp, signals.pv, signals.dv)
            )
            mv, state, info = law(sp, pv, dv, mv, state, *more)
            found += [mv, state, info]
    return found


@pytest.mark.parametrize("n_hidden", [0, 4])
@pytest.mark.parametrize("operate", [None, {}])
def test_nothing_to_come_is_the_law_without_it_to_the_bit(n_hidden: int, operate: dict[str, float] | None) -> None:
    model = random_model(3, n_y=2, n_mv=2, n_dv=1, n_hidden=n_hidden)
    held, course = (law_of(model, horizon=N, operate=operate, preview=p) for p in ("held", "course"))
    assert course.ahead is not None
    assert (course.ahead.size, course.n_state) == (3 * N, held.n_state)
    zeros = torch.zeros(course.ahead.size, dtype=torch.float64)
    wanted = stepped(held, 15, None)
    for found in (stepped(course, 15, zeros), stepped(course, 15, None)):
        assert all(torch.equal(a, b) for a, b in zip(wanted, found, strict=True))
    assert not torch.equal(stepped(course, 15, zeros + 0.3)[0], wanted[0])


@pytest.mark.parametrize("n_hidden", [0, 4])
def test_the_free_run_under_a_forecast_is_the_models(n_hidden: int) -> None:
    """Step by step, with a disturbance that changes at each sample."""
    model, rng = random_model(7, n_y=2, n_mv=1, n_dv=2, n_hidden=n_hidden), np.random.default_rng(1)
    loads, moves = loads_of(model, "outputs", N), Moves.over(N, 4, 1)
    horizon = horizon_of(model, loads, moves, lambda z: z, 2, forecasts=True)
    x, d, dv, plan = (torch.from_numpy(rng.normal(size=(1, n))) for n in (model.n_x, 2, 2, moves.count))
    later = torch.from_numpy(0.5 * rng.normal(size=(N, 2)))
    found = horizon(torch.cat([x, d, dv], dim=-1), plan, horizon.forecast(later.reshape(1, -1))).y.reshape(N, 2)
    mv, at = moves.courses(plan)[0], x[0]
    for i in range(N):
        now = dv[0] if i == 0 else dv[0] + later[i - 1]
        at = model(torch.cat([at, mv[i], now])) + loads.into_x @ d[0]
        np.testing.assert_allclose(found[i], at[:2], atol=1e-10)


def test_the_last_sample_of_a_forecast_acts_beyond_the_horizon() -> None:
    law = law_of(random_model(3, n_dv=1, n_hidden=0), **COURSE)
    assert law.ahead is not None
    last = torch.zeros(law.ahead.size, dtype=torch.float64)
    last[-1] = 0.5
    assert all(torch.equal(a, b) for a, b in zip(stepped(law, 3, last), stepped(law, 3, 0 * last), strict=True))


def mean_error(
    law: Predictive, plant: Identified, sp: np.ndarray, dv: np.ndarray, *, told: bool
) -> tuple[float, Tensor]:
    """Mean error of a loop from rest, and its MVs (n, n_mv)."""
    x, state, mv = torch.zeros(plant.n_x).double(), torch.zeros(law.n_state).double(), torch.zeros(plant.n_mv).double()
    errors, moved = [], []
    with torch.no_grad():
        for k in range(len(sp)):
            y = plant.measured(x)
            errors.append(np.abs(y.numpy() - sp[k]).mean())
            at = np.minimum(k + np.arange(1, N + 1), len(sp) - 1)
            change = np.hstack([sp[at] - sp[k], dv[at] - dv[k]])
            ahead = torch.from_numpy(change.ravel()) if told else torch.zeros(change.size).double()
            given = torch.from_numpy(dv[k]) if plant.n_dv else NONE
            mv, state, _ = law(torch.from_numpy(sp[k]), y, given, mv, state, None, None, ahead)
            moved.append(mv)
            x = plant(torch.cat([x, mv, given]))
    return float(np.mean(errors)), torch.stack(moved)


def test_a_known_step_of_the_set_point_is_prepared_and_a_held_law_waits() -> None:
    model = first_order(pole=0.9, dead=3)
    law, sp = law_of(model, **COURSE), np.repeat([0.0, 1.0, -0.5], 25)[:, None]
    none = np.zeros((len(sp), 0))
    (waits, late), (prepares, early) = (mean_error(law, model, sp, none, told=told) for told in (False, True))
    assert prepares < 0.5 * waits
    assert torch.all(late[:25].abs() < 1e-9)
    assert early[24, 0] > 0.1  # before the step


def test_a_forecast_of_a_disturbance_makes_up_for_the_dead_time() -> None:
    """The MV acts three samples late and the disturbance at once: only who knows it before keeps the set point."""
    model = first_order(pole=0.9, dead=3, disturbance=1.0)
    law, sp = law_of(model, **COURSE, move_weight=0.001), np.zeros((60, 1))
    dv = np.repeat([0.0, 0.6], 30)[:, None]
    (waits, late), (prepares, early) = (mean_error(law, model, sp, dv, told=told) for told in (False, True))
    assert prepares < 0.5 * waits
    assert torch.all(late[:30].abs() < 1e-9)
    assert early[29, 0] < -0.05


def test_a_set_point_to_come_beyond_a_soft_limit_counts_as_one_at_the_limit() -> None:
    law = law_of(first_order(), **COURSE, cv_high=(0.8,))
    beyond, at, nothing = (torch.full((N,), by, dtype=torch.float64) for by in (1.5, 0.8, 0.0))
    state, none = torch.zeros(law.n_state).double(), NONE
    first = [law(row(0.0), row(0.0), none, row(0.0), state, None, None, by)[0] for by in (beyond, at, nothing)]
    assert torch.equal(first[0], first[1])
    assert first[0] > first[2] + 0.01


def test_a_forecast_counts_from_the_level_of_a_noisy_disturbance() -> None:
    """A reading that is off by noise moves the MV by what its level moves, with a forecast as without."""
    model = first_order(pole=0.9, dead=2, disturbance=1.0)
    model.dv_noise.fill_(0.2)
    model.dv_change.fill_(0.01)
    law = law_of(model, **COURSE)

    def moved(reading: float, change: float) -> float:
        state, mv = torch.zeros(law.n_state).double(), row(0.0)
        both = torch.stack([torch.zeros(N).double(), torch.full((N,), change).double()], dim=-1).flatten()
        for k in range(3):
            known = both if k == 2 else 0 * both
            mv, state, _ = law(row(0.0), row(0.0), row(reading if k == 2 else 0.0), row(0.0), state, None, None, known)
        return float(mv)

    alone, noise = moved(0.0, 0.1) - moved(0.0, 0.0), moved(0.3, 0.1) - moved(0.3, 0.0)
    assert alone < -0.01
    assert abs(noise / alone - 1) < 0.25
    assert abs(moved(0.3, 0.0)) < 0.5 * abs(moved(0.3, 0.1))


def test_outputs_without_a_set_point_have_no_course() -> None:
    model = random_model(5, n_y=2, n_mv=1, n_hidden=0)
    signals = made_signals(2, 1)
    fewer = type(signals)(1.0, signals.sp[:1], signals.pv, (), signals.mv)
    law = Predictive(fewer, model, Predictive.Params(**COURSE, operate={})).eval()
    assert law.ahead is not None
    assert [s.signal for s in law.ahead.signals] == ["y0"]
    assert law.known is not None
    later, _ = law.known(torch.arange(1.0, N + 1).double())
    np.testing.assert_allclose(later.reshape(N, 2)[:, 0], np.arange(1, N + 1))
    assert not later.reshape(N, 2)[:, 1].any()


def test_the_word_is_a_preview_among_those_allowed() -> None:
    assert parse(Predictive.Params, {"preview": "course"}, "predictive").preview == "course"
    with pytest.raises(ParamsError, match="course"):
        parse(Predictive.Params, {"preview": "recipe"}, "predictive")
