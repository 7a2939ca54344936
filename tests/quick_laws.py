"""Fixtures that run over PLANTS and LAWS, so that a new member is covered by the contract tests at once."""

from __future__ import annotations

import dataclasses
import gc
import os
import signal
from collections.abc import Callable
from functools import cache
from typing import Any

import henson_seborg_cstr_parts
import hypothesis
import identified_models
import jacketed_batch_reactor_parts
import numpy as np
import pytest
import reversible_cstr_parts
import torch
from shipped import required
from threadpoolctl import threadpool_limits

from loopwright.pipeline.cases import PLANTS
from loopwright.pipeline.export import gate
from loopwright.pipeline.laws import LAWS, ControlLaw
from loopwright.pipeline.models import Model
from loopwright.pipeline.models.lagged.lagged import ARX, NNARX
from loopwright.pipeline.models.static.fuzzy_means import FuzzyMeansRBF
from loopwright.pipeline.models.static.leverage_domain import LeverageDomain
from loopwright.pipeline.models.training.fit import LevenbergMarquardt
from loopwright.pipeline.models.training.objectives import Samples
from loopwright.pipeline.plants.equations import EquationPlant
from loopwright.pipeline.plants.simulator import Signals
from loopwright.pipeline.simulation.scenario import Scenario
from loopwright.pipeline.simulation.simulate import simulate_batch

# What is imported stays: looking through it for garbage again and again takes a tenth of all CPU time.
gc.disable()

# The same examples on each run, however slow the machine is.
hypothesis.settings.register_profile("same", derandomize=True, deadline=None, database=None)
hypothesis.settings.load_profile("same")

# A job that a shell puts in the background hears no Ctrl-C, and no program that it starts would.
signal.signal(signal.SIGINT, signal.default_int_handler)

# Models and matrices of the tests are small, and each core has a worker: more threads spend up to half of a test's CPU
# time on waiting for each other. Here, and in the processes that a test starts.
torch.set_num_threads(1)
threadpool_limits(1)
os.environ.setdefault("OMP_NUM_THREADS", "1")

# Steps of an export's parity gate: a law that differs from its graph differs within some of them, and most tests export
# for another reason. test_export.py takes all of them.
STEPS_OF_GATE, gate.GATE_STEPS = gate.GATE_STEPS, 60

# What a law's params need beside their defaults, and what lets it be designed quickly.
QUICK_PARAMS: dict[str, dict[str, Any]] = {name: dict(required(name)) for name in LAWS}
# Lower gains than the defaults, whose loops test_units_of_laws.py runs: over quick networks of an unstable plant and
# inputs drawn over whole ranges the defaults keep the MV at its ends, where laws cannot be told apart.
CALM: dict[str, Any] = {"penalty": 1.0, "stiffness": 1e-3, "gain_high": (10.0,) * 3, "slope_min": 1e-3}
for _name in ("linearized_pid", "gauss_newton_pid", "minimum_variance", "recursive_pid", "self_tuning_pid"):
    _known = {f.name for f in dataclasses.fields(LAWS[_name].Params)}
    _calm = {**CALM, "penalty": 0.1} if _name in ("gauss_newton_pid", "minimum_variance") else CALM
    QUICK_PARAMS[_name] |= {key: value for key, value in _calm.items() if key in _known}
QUICK_PARAMS["predictive"] |= {"horizon": 8, "moves": 4}
QUICK_PARAMS["pid"] |= {"tuning": "imc", "lambda_s": 1.6, "operating_cv": 0.66613}
for _name in ("model_reference", "model_reference_two_error", "pi_reference"):
    QUICK_PARAMS[_name] |= reversible_cstr_parts.QUICK_PARAMS
ADAPTIVE = {"adaptive": True, "penalty_start": 20.0, "penalty_low": 0.1, "eps_high": 0.2, "eps_low": 0.05}
# Forms of a law that its defaults do not reach, under the contract too.
VARIANTS: dict[str, list[dict[str, Any]]] = {
    "incadec": [{"correction": "back_calculation"}],
    "linearized_pid": [
        ADAPTIVE,
        {**ADAPTIVE, "momentum": 0.4, "window": 5, "noise_variance": 1e-4, "offset_filter": 0.3, "trust": 0.6},
        {"preview": "ramp", "trust": 0.5},
        {"momentum": 0.4, "window": 2, "noise_variance": 1e-4},
    ],
    "gauss_newton_pid": [{"relinearize": 1, "momentum": 0.3, "offset_filter": 0.5}],
    "minimum_variance": [{"relinearize": 1, "preview": "ramp", "offset_filter": 0.8}],
    "recursive_pid": [
        {"preview": "ramp", "momentum": 0.4, "window": 3, "noise_variance": 1e-4, "offset_filter": 0.5},
        {"forgetting": 1.0, "offset_filter": 0.0},
    ],
    "self_tuning_pid": [{"prefilter": (0.5,), "forgetting": 1.0}],
    "model_reference": [{"order": 4}],
    "pi_reference": [{"tuning": "manual", "kc": -45.0, "ti_s": 5.0, "order": 1}],
    "predictive": [
        {"passes": 1, "mv_rate": 20.0, "speed": 0.5},
        {"passes": 1, "moves": 3, "preview": "ramp", "cv_high": (9.0,)},
    ],
    "local_pid_network": [{"blending": "outputs"}, {"blending": "velocity"}],
}
# The plant that a law is for; the others are designed over the first case's.
PLANT_OF_LAW: dict[str, str] = {
    "local_pid_network": "henson_seborg_cstr",
    "auto_pid_network": "henson_seborg_cstr",
    **dict.fromkeys(("model_reference", "model_reference_two_error", "pi_reference"), "reversible_cstr"),
    "predictive": "ph_neutralization",
    **dict.fromkeys(jacketed_batch_reactor_parts.LAWS, "jacketed_batch_reactor"),
}
# Set points that a plant is put to rest at; of a plant that is not named, three within its range.
AT_REST: dict[str, tuple[float, float, float]] = {"thiosulfate_cstr": (0.1, 0.66613, 0.97)}
HORIZON = 3

LawFactory = Callable[..., ControlLaw]


def pytest_collection_finish() -> None:
    """All modules are imported: from here on garbage is looked for, not among them, and seldom."""
    gc.freeze()
    gc.set_threshold(50_000)  # Python's 700 takes a twentieth of all CPU time: tracing makes many objects that stay
    gc.enable()


@pytest.fixture(scope="session")
def plant() -> EquationPlant:
    """The plant of the first case."""
    return PLANTS["thiosulfate_cstr"]()


@pytest.fixture(scope="session")
def signals(plant: EquationPlant) -> Signals:
    return plant.signals


def plant_of(law: str) -> EquationPlant:
    """The plant that a law is designed over."""
    return PLANTS[PLANT_OF_LAW.get(law, "thiosulfate_cstr")]()


def rest_points(plant: EquationPlant) -> tuple[float, float, float]:
    """Three set points that the plant can hold."""
    sp = plant.sp_signals[0]
    low, middle, high = (sp.low + f * (sp.high - sp.low) for f in (0.2, 0.5, 0.8))
    return AT_REST.get(plant.name, (low, middle, high))


@pytest.fixture(scope="session")
def parts() -> dict[str, Model]:
    """The quick model set of the first case."""
    return quick_parts("thiosulfate_cstr")


@cache
def quick_parts(plant: str) -> dict[str, Model]:
    """The quick model set of a plant."""
    return PARTS[plant](PLANTS[plant]())


def _thiosulfate_parts(plant: EquationPlant) -> dict[str, Model]:
    """A model set with every part that a law may ask for: small networks over short random runs.

    Good enough to be smooth and finite; nothing is asserted of their accuracy.
    """
    rng = np.random.default_rng(0)
    cvs, xs, _ = plant.steady_curve
    start = rng.integers(0, len(cvs), 400)
    mv = plant.mv_signals[0]
    runs = np.repeat(rng.uniform(mv.low, mv.high, (400, 4, 1)), HORIZON, axis=1)
    x = simulate_batch(plant, xs[start], runs)
    now, moves = x[:, :-HORIZON].reshape(-1, x.shape[2]), runs[:, : 1 - HORIZON].reshape(-1, 1)
    held = np.tile(np.arange(x.shape[1] - HORIZON) % HORIZON == 0, len(x))

    def ahead(h: int) -> np.ndarray:
        return x[:, h : x.shape[1] - HORIZON + h].reshape(-1, x.shape[2])

    def network(inputs: np.ndarray, target: np.ndarray) -> Model:
        return FuzzyMeansRBF(8).fit(inputs, target).to_torch()

    def lagged(samples: Samples) -> Model:
        phi = samples.x
        model = NNARX.scaled_to(phi, samples.y, n_y=2, n_u=2, hidden=(6,), residual=True)
        LevenbergMarquardt(iterations=20).fit(model.net, samples, samples, seed=0)
        return model.eval()

    y, u = x[:, :, 0], runs[:, :, 0]
    phi = np.stack([y[:, 1:-1], y[:, :-2], u[:, 1:], u[:, :-1]], axis=-1).reshape(-1, 4)
    lags = Samples(phi, y[:, 2:].reshape(-1, 1))
    one, forward = np.column_stack([now, ahead(1)[:, 0]]), np.column_stack([now, moves])
    return {
        "inverse": network(one, moves),
        "domain": LeverageDomain.fit(one),
        "forward": network(forward[held], ahead(HORIZON)[held, 0]),
        "observer": network(forward, ahead(1)[:, 1]),
        "nnarx": lagged(lags),
        "arx": ARX.fit(lags.x, lags.y, n_y=2, n_u=2),
    }


PARTS: dict[str, Callable[[EquationPlant], dict[str, Model]]] = {
    "thiosulfate_cstr": _thiosulfate_parts,
    "henson_seborg_cstr": henson_seborg_cstr_parts.parts,
    "jacketed_batch_reactor": jacketed_batch_reactor_parts.parts,
    "ph_neutralization": identified_models.parts,
    "reversible_cstr": reversible_cstr_parts.parts,
}


@pytest.fixture(scope="session")
def make_law() -> LawFactory:
    """``make_law(name, **params)``: a law of LAWS over its plant's quick model set."""

    def make(name: str, **params: Any) -> ControlLaw:
        cls, plant = LAWS[name], plant_of(name)
        given = cls.Params(**{**QUICK_PARAMS[name], **params})
        return cls.design(given, quick_parts(plant.name), plant.signals, plant).eval()

    return make


FORMS = [(name, form) for name in sorted(LAWS) for form in ({}, *VARIANTS.get(name, []))]


@pytest.fixture(scope="session", params=FORMS, ids=lambda f: "-".join([f[0], *map(str, f[1].values())]))
def law(request: pytest.FixtureRequest, make_law: LawFactory) -> ControlLaw:
    """Every law in turn."""
    name, form = request.param
    return make_law(name, **form)


@pytest.fixture(scope="session")
def law_plant(law: ControlLaw) -> EquationPlant:
    """The plant of the law in turn."""
    return plant_of(law.name)


@pytest.fixture(scope="session")
def loop_test() -> Callable[..., Scenario]:
    """``loop_test(plant, levels (n,), start, NAME=value)``: from the steady state at ``start``, parameters changed."""

    def make(plant: EquationPlant, levels: np.ndarray, start: float, **changed: float) -> Scenario:
        x0, mv0 = plant.steady_state_at(start)
        changes = {name: np.full(len(levels), value) for name, value in changed.items()}
        return Scenario("made", "made", levels[:, None], x0, mv0, changes)

    return make
