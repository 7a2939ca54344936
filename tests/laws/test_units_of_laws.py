"""A law does not depend on the units of its signals: the same plant in other units gives the same closed loop."""

from __future__ import annotations

import dataclasses
import pickle
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
import pytest
import torch
from quick_laws import CALM, FORMS, QUICK_PARAMS, plant_of, quick_parts, rest_points

from loopwright.pipeline.config.params import parse
from loopwright.pipeline.errors import LawError, ParamsError
from loopwright.pipeline.laws import LAWS, ControlLaw
from loopwright.pipeline.laws.base import OfRange
from loopwright.pipeline.models import Model
from loopwright.pipeline.models.hybrid_fuzzy import HybridFuzzy
from loopwright.pipeline.models.local_models import LocalModels
from loopwright.pipeline.models.static.mlp import MLP
from loopwright.pipeline.plants.simulator import Signals
from loopwright.pipeline.simulation.scenario import Scenario
from loopwright.pipeline.simulation.simulate import simulate_closed
from loopwright.serving.manifest import Signal

PV, MV = 1000.0, 0.01  # K in mK, % in shares: factors of all PVs, and of all MVs that are not on or off
HOLD = 12
# Stated parameters in units of their own: powers of the factors of the PV and of the MV.
POWERS = {
    **dict.fromkeys(("penalty", "penalty_start", "penalty_low", "noise_variance"), (2, 0)),
    **dict.fromkeys(("band", "eps_high", "eps_low", "jacket_low", "jacket_high", "switch_penalty"), (1, 0)),
    "integral": (-1, 0),
    **dict.fromkeys(("cv_low", "cv_high"), (1, 0)),
    "mv_rate": (0, 1),
}


def factor(name: str, law: str) -> float:
    pv, mv = POWERS.get(name, (0, 0))
    if name == "kc" and not law.startswith("fuzzy"):  # there a cascade's, jacket over core
        pv, mv = -1, 1
    return float(PV**pv * MV**mv)


def in_other_units(value: Any, by: float) -> Any:
    if isinstance(value, tuple):
        return tuple(v * by for v in value)
    return value * by if isinstance(value, float) else value


def scaled_signals(signals: Signals) -> Signals:
    def scaled(group: tuple[Signal, ...], by: float) -> tuple[Signal, ...]:
        return tuple(s if s.values else dataclasses.replace(s, low=s.low * by, high=s.high * by) for s in group)

    groups = {"sp": PV, "pv": PV, "mv": MV}
    return dataclasses.replace(signals, **{k: scaled(getattr(signals, k), by) for k, by in groups.items()})


def with_buffers(model: Model, factors: Mapping[str, Any], drop: str = "") -> Model:
    """A copy of a model, some of its buffers multiplied."""
    arrays = {k: v.numpy() * factors.get(k.removeprefix(drop), 1.0) for k, v in model.state_dict().items()}
    return type(model).from_arrays(model.config(), arrays)


def scaled_part(name: str, model: Model, n_pv: int) -> Model:
    """The model of the same plant in the other units."""
    if isinstance(model, HybridFuzzy):
        rows = np.array([1.0, 1.0, PV / MV, PV])[:, None]
        config = (model.centres.numpy() * PV, model.consequents.numpy() * rows, model.core.numpy())
        return HybridFuzzy(*(v.tolist() for v in config))
    if isinstance(model, LocalModels):
        points = [dataclasses.replace(p, x=p.x * PV, mv=p.mv * MV, b=p.b * PV / MV) for p in model.linearizations()]
        return LocalModels.of(points, model.width.numpy() * PV, model.period_s)
    if name == "arx":
        inputs = np.array([PV] * model.n_y + [MV] * model.n_u)
        return with_buffers(model, {"weight": PV / inputs, "bias": PV})
    if name == "identified":
        return with_buffers(model, {"y_center": PV, "y_scale": PV, "v_center": MV, "v_scale": MV})
    if name == "domain":
        project = np.full((n_pv, n_pv + 1), 1 / PV)
        project[:, -1] = 1.0
        return with_buffers(model, {"mean_x": PV, "mean_w": PV, "scale": PV, "project": project})
    n_in, out = (n_pv + 1, MV) if name == "inverse" else (n_pv + 1, PV)
    inputs = np.full(n_in, PV)
    inputs[-1] = PV if name == "inverse" else MV
    if name == "nnarx":
        inputs = np.array([PV] * model.n_y + [MV] * model.n_u)
    if isinstance(getattr(model, "net", model), MLP):
        factors = {"x_center": inputs, "x_scale": inputs, "y_center": out, "y_scale": out}
        return with_buffers(model, factors, drop="net.")
    return with_buffers(model, {"low": inputs, "span": inputs, "weights": out})  # radial basis functions


def designed(name: str, **form: Any) -> ControlLaw:
    """A law with its defaults, but for ``form`` and what makes it quick."""
    plant, cls = plant_of(name), LAWS[name]
    return cls.design(cls.Params(**{**quick(name), **form}), quick_parts(plant.name), plant.signals, plant).eval()


def quick(name: str) -> dict[str, Any]:
    return {key: value for key, value in QUICK_PARAMS[name].items() if key not in CALM}


def closed_loop(law: ControlLaw, levels: np.ndarray, pv_by: float, mv_by: np.ndarray, loop_test: Any) -> np.ndarray:
    """MVs (n, n_mv) in the plant's units; the law's units lie between it and the plant."""
    plant = plant_of(law.name)
    test = loop_test(plant, np.repeat(levels, HOLD), float(levels[0]))
    state, dv = torch.zeros(law.n_state, dtype=torch.float64), torch.from_numpy(plant.dv_nominal)

    def step(sp: np.ndarray, pv: np.ndarray, applied: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        nonlocal state
        given = (torch.from_numpy(v) for v in (sp * pv_by, pv * pv_by))
        with torch.no_grad():
            mv, state, _ = law(*given, dv, torch.from_numpy(applied * mv_by), state)
        return mv.numpy() / mv_by, np.zeros(0)

    return simulate_closed(plant, step, test).mv


# A PID is tuned from the plant itself, which has the units that it has.
@pytest.mark.parametrize(
    ("name", "form"),
    [f for f in FORMS if f[0] != "pid"],
    ids=lambda v: v if isinstance(v, str) else "-".join(map(str, v.values())),
)
def test_other_units_give_the_same_closed_loop(
    name: str, form: dict[str, Any], loop_test: Callable[..., Scenario]
) -> None:
    plant, cls = plant_of(name), LAWS[name]
    one = designed(name, **form)
    given = {key: in_other_units(value, factor(key, name)) for key, value in {**quick(name), **form}.items()}
    if "training" in given:
        given["training"] = dataclasses.replace(given["training"], noise=given["training"].noise * PV)
    models = {key: scaled_part(key, m, len(plant.pv_signals)) for key, m in quick_parts(plant.name).items()}
    other = cls.design(cls.Params(**given), models, scaled_signals(plant.signals), None).eval()
    by = np.array([1.0 if s.values else MV for s in plant.mv_signals])
    levels = np.array(rest_points(plant))[[1, 2, 0, 1]]
    found = closed_loop(one, levels, 1.0, np.ones(len(by)), loop_test)
    turned = closed_loop(other, levels, PV, by, loop_test)
    span = np.array([s.high - s.low for s in plant.mv_signals])
    assert np.ptp(found[:, 0]) > 1e-3 * span[0]  # the loop did something
    np.testing.assert_allclose(turned / span, found / span, rtol=0, atol=1e-5)


def test_what_is_stated_is_taken_as_it_is_and_what_is_not_follows_from_the_range() -> None:
    law = designed("gauss_newton_pid", slope_min=0.25)
    sp = law.signals.sp[0]
    span = sp.high - sp.low
    assert float(law.gains.slope_min) == 0.25
    assert float(law.gains.lam) == pytest.approx(1e-9 * span**4)
    assert law.gains.hi.tolist() == pytest.approx([100 / span] * 3)


def test_a_default_is_shown_with_its_unit_and_travels_to_another_process() -> None:
    defaults = {f.name: f.default for f in dataclasses.fields(LAWS["gauss_newton_pid"].Params)}
    assert str(defaults["penalty"]) == "0.001 * range^2"
    assert str(defaults["gain_high"]) == "(100 / range, 100 / range, 100 / range)"
    copied = pickle.loads(pickle.dumps(defaults["stiffness"]))
    assert (copied, copied.power) == (1e-9, 4)
    assert OfRange(0.5, -1).over(4.0) == 0.125


def test_a_stated_bound_beside_a_default_one_is_checked_once_the_range_is_known() -> None:
    given = {"gain_low": [300.0, 0.0, 0.0]}
    params = parse(LAWS["linearized_pid"].Params, given, "controllers.it")  # 300 may be below 100 / range
    with pytest.raises(LawError, match=r"law 'linearized_pid': gain_low is \[300.0, 0.0, 0.0\] and gain_high \[100.0"):
        designed("linearized_pid", gain_low=params.gain_low)
    with pytest.raises(ParamsError, match="gain_low is"):
        parse(LAWS["linearized_pid"].Params, {**given, "gain_high": [200.0, 1.0, 1.0]}, "controllers.it")
    with pytest.raises(LawError, match=r"law 'linearized_pid': penalty_low is 0\.5 and penalty_start 0\.001"):
        designed("linearized_pid", penalty_low=0.5)
