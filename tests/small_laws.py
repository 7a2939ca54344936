"""Laws of the serving tests' own, exported once a session. Loaded by ``pytest_plugins``, not imported."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, Self

import onnx
import pytest
import torch
from torch import Tensor

from loopwright.pipeline.export.controller_file import file_bytes, with_evidence
from loopwright.pipeline.export.gate import export
from loopwright.pipeline.laws import ControlLaw
from loopwright.pipeline.plants.simulator import Signals
from loopwright.serving import Controller, Signal
from loopwright.serving.controller_file import TRAILER_BYTES

SIGNALS = Signals(
    period_s=0.5,
    sp=(Signal("level", "m", 0.0, 2.0),),
    pv=(Signal("level", "m", 0.0, 2.0), Signal("T", "K", 250.0, 400.0)),
    dv=(Signal("inflow", "l/s", 0.0, 3.0),),
    mv=(Signal("valve", "%", 0.0, 100.0),),
)
Formula = Callable[..., tuple[Tensor, Tensor, Tensor]]


class FormulaLaw(ControlLaw):
    """A law whose forward is a function: ``formula(law, sp, pv, dv, mv_applied, state)``."""

    name = "formula"
    title = "Formula"
    Params = type(None)

    def __init__(self, formula: Formula, n_state: int, info: tuple[str, ...], signals: Signals) -> None:
        super().__init__(signals)
        self.formula, self.n_state, self.info = formula, n_state, info

    @classmethod
    def design(cls, params: Any, models: Mapping[str, Any], signals: Signals, plant: Any) -> Self:
        raise NotImplementedError

    def forward(self, *inputs: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        return self.formula(self, *inputs)


def pi(law: ControlLaw, sp: Tensor, pv: Tensor, dv: Tensor, mv_applied: Tensor, state: Tensor) -> Any:
    """Velocity-form PI: state = (started, last error)."""
    error = sp - pv[..., :1]
    last = torch.where(state[..., :1] > 0, state[..., 1:], error)
    mv = law.limited(mv_applied + 20.1 * (error - last) + 1.3 * error, mv_applied)
    return mv, torch.cat([torch.ones_like(error), error], dim=-1), torch.cat([error, mv - mv_applied], dim=-1)


@pytest.fixture(scope="session")
def make_formula() -> Callable[..., ControlLaw]:
    """``make_formula(formula, n_state=0, info=(), signals=SIGNALS)``: a law from a function."""

    def make(formula: Formula, n_state: int = 0, info: tuple[str, ...] = (), signals: Signals = SIGNALS) -> ControlLaw:
        return FormulaLaw(formula, n_state, info, signals).eval()

    return make


@pytest.fixture(scope="session")
def pi_law(make_formula: Callable[..., ControlLaw]) -> ControlLaw:
    return make_formula(pi, 2, ("error", "move"))


@pytest.fixture(scope="session")
def pi_file(pi_law: ControlLaw, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("controller") / "pi.onnx"
    export(pi_law, path, case="tank", provenance={"git": "0123abc"})
    with_evidence(path, path, {"step": {"mae": 0.25, "ise": 0.5}})
    return path


@pytest.fixture
def controller(pi_file: Path) -> Controller:
    return Controller(pi_file)


def with_feedforward(law: ControlLaw, sp: Tensor, pv: Tensor, dv: Tensor, mv_applied: Tensor, state: Tensor) -> Any:
    """PI with a feedforward of the measured disturbance: state = (sum of errors)."""
    error = sp - pv[..., :1]
    total = state + error
    mv = law.limited(mv_applied + 40.0 * error + 3.0 * total - 4.0 * (dv - 1.5), mv_applied)
    return mv, total, dv * error


STRICTER = {"range": Signal("valve", "%", 10.0, 90.0), "move": Signal("valve", "%", 0.0, 100.0, max_move=30.0)}


@pytest.fixture(scope="session", params=list(STRICTER))
def disobedient_file(
    make_formula: Callable[..., ControlLaw], tmp_path_factory: pytest.TempPathFactory, request: pytest.FixtureRequest
) -> Path:
    """A controller that takes a measured disturbance and does with its MV what its manifest does not allow."""
    path = tmp_path_factory.mktemp("controller") / "disobedient.onnx"
    export(make_formula(with_feedforward, 1, ("product",)), path, case="tank", provenance={})
    narrow = replace(Controller(path).manifest, mv=(STRICTER[request.param],))
    model = onnx.ModelProto.FromString(path.read_bytes()[:-TRAILER_BYTES])
    del model.metadata_props[:]
    path.write_bytes(file_bytes(model.SerializeToString(), narrow))
    return path
