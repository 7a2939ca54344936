"""Networks and closed loops for the tests of the laws over an NNARX. Not a test."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np

from loopwright.pipeline.excitation import Excitation
from loopwright.pipeline.laws import LAWS, ControlLaw
from loopwright.pipeline.models import MODELS, Model
from loopwright.pipeline.models.lagged.lagged import NNARX
from loopwright.pipeline.models.part import Source
from loopwright.pipeline.plants.equations import EquationPlant
from loopwright.pipeline.plants.simulator import Signals
from loopwright.pipeline.simulation.simulate import Trajectory
from loopwright.serving.manifest import Signal


def trained(plant: EquationPlant, excitation: Excitation, lags: int, seed: int = 0) -> NNARX:
    """An NNARX as params.yaml asks for it, without the figures that its report shows."""
    part = MODELS["nnarx"](n_y=lags, n_u=lags, hidden=(10,), steps=10, compared=0)
    model = part.learn(Source(excitation.run(plant, seed), plant.signals, seed=seed)).model
    assert isinstance(model, NNARX)
    return model


def designed(
    name: str, model: Model, plant: EquationPlant, signals: Signals | None = None, **params: Any
) -> ControlLaw:
    law = LAWS[name]
    return law.design(law.Params(**params), {"nnarx": model}, signals or plant.signals, plant).eval()


def info(law: ControlLaw, track: Trajectory) -> dict[str, np.ndarray]:
    return dict(zip(law.info, track.info.T, strict=True))


def mirrored(signal: Signal) -> Callable[[np.ndarray], np.ndarray]:
    """What turns a signal's range round."""
    return lambda value: signal.low + signal.high - value


def mirrored_in_mv(model: NNARX, mv: Signal) -> NNARX:
    """The same plant's model, whose MV has been turned round."""
    other = NNARX(**model.config())
    other.load_state_dict(model.state_dict())
    net = other.net
    net.x_center[model.n_y :] = mirrored(mv)(net.x_center[model.n_y :])
    net.x_scale[model.n_y :] *= -1
    return other.eval()


def negated_in_pv(model: NNARX) -> NNARX:
    """The model of a plant that measures -y."""
    other = NNARX(**model.config())
    other.load_state_dict(model.state_dict())
    net = other.net
    net.x_center[: model.n_y] *= -1
    net.x_scale[: model.n_y] *= -1
    net.y_center *= -1
    net.y_scale *= -1
    return other.eval()


def negated_signals(signals: Signals) -> Signals:
    """The signals of a plant that measures -y."""

    def negated(group: tuple[Signal, ...]) -> tuple[Signal, ...]:
        return tuple(replace(s, low=-s.high, high=-s.low) for s in group)

    return replace(signals, sp=negated(signals.sp), pv=negated(signals.pv))
