"""Controllers that read ``operate`` and ``fresh``, once a session. Loaded by ``pytest_plugins``, not imported."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from identified_models import made_signals, random_model
from operated_law import ENTRIES, NARROW_ENTRIES, OTHER_ENTRIES, PLANT, OperatedLaw
from predictive_loops import law_of
from torch import Tensor

from loopwright.pipeline.export.gate import export
from loopwright.pipeline.laws import ControlLaw
from loopwright.pipeline.laws.predictive.predictive import Predictive
from loopwright.serving import Controller


def _exported(law: ControlLaw, folder: Path) -> Controller:
    export(law.eval(), folder / "law.onnx", case="plant", provenance={})
    return Controller(folder / "law.onnx")


@pytest.fixture(scope="session")
def operated(tmp_path_factory: pytest.TempPathFactory) -> Controller:
    """A law with ``ENTRIES``."""
    return _exported(OperatedLaw(ENTRIES), tmp_path_factory.mktemp("operated"))


@pytest.fixture(scope="session")
def otherwise_operated(tmp_path_factory: pytest.TempPathFactory) -> Controller:
    """A law with ``OTHER_ENTRIES``, of the same signals."""
    return _exported(OperatedLaw(OTHER_ENTRIES), tmp_path_factory.mktemp("other"))


@pytest.fixture(scope="session")
def narrow(tmp_path_factory: pytest.TempPathFactory) -> Controller:
    """A law with ``NARROW_ENTRIES``, of the same signals."""
    return _exported(OperatedLaw(NARROW_ENTRIES), tmp_path_factory.mktemp("narrow"))


@pytest.fixture(scope="session")
def not_operated(make_formula: Callable[..., ControlLaw], tmp_path_factory: pytest.TempPathFactory) -> Controller:
    """A law of the same signals without ``operate`` and ``fresh``."""

    def formula(law: Any, sp: Tensor, pv: Tensor, dv: Tensor, mv_applied: Tensor, state: Tensor) -> Any:
        at = 50.0 + sp[..., :1] - pv[..., :1]
        return law.limited(torch.cat([at, 0.0 * at], dim=-1), mv_applied), state, pv[..., :0]

    return _exported(make_formula(formula, signals=PLANT), tmp_path_factory.mktemp("not"))


@pytest.fixture(scope="session")
def predictive_model() -> Any:
    """A plant of two outputs and two MVs."""
    return random_model(3, n_y=2, n_mv=2, n_hidden=0)


@pytest.fixture(scope="session")
def predictive(predictive_model: Any, tmp_path_factory: pytest.TempPathFactory) -> Controller:
    """The predictive law of ``predictive_model`` that reads both."""
    return _exported(law_of(predictive_model, horizon=15, operate={}), tmp_path_factory.mktemp("predictive"))


@pytest.fixture(scope="session")
def slow_mvs(predictive_model: Any, tmp_path_factory: pytest.TempPathFactory) -> Controller:
    """The same law, whose MVs move by at most .1 V a period."""
    signals = made_signals(predictive_model.n_y, predictive_model.n_mv)
    limited = replace(signals, mv=tuple(replace(s, max_move=0.1) for s in signals.mv))
    law = Predictive(limited, predictive_model, Predictive.Params(horizon=15, operate={}))
    return _exported(law, tmp_path_factory.mktemp("slow"))
