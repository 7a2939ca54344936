"""Operations that ONNX lacks are replaced by those that compute the same bits, without a second trace."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import onnxruntime
import pytest
import torch
from torch import Tensor

from loopwright.pipeline.export import graph
from loopwright.pipeline.export.graph import law_graph
from loopwright.pipeline.laws import ControlLaw

pytest_plugins = ["small_laws"]
Make = Callable[..., ControlLaw]


def replaced(law: Any, sp: Tensor, pv: Tensor, dv: Tensor, mv_applied: Tensor, state: Tensor) -> Any:
    """One of each operation that is replaced."""
    both = (sp > 0.3) & (pv[:1] > 0.4)
    one_and_none = torch.eye(2, dtype=torch.float64) @ torch.cat([sp, pv[:1]])
    return law.limited(1.0 - both.to(torch.float64) * one_and_none[:1] + one_and_none[1:], mv_applied), state, pv[:1]


def written_in_place(law: Any, sp: Tensor, pv: Tensor, dv: Tensor, mv_applied: Tensor, state: Tensor) -> Any:
    total = sp * 2.0
    total.add_(pv[:1])
    return law.limited(total, mv_applied), state, pv[:1]


def lacking(law: Any, sp: Tensor, pv: Tensor, dv: Tensor, mv_applied: Tensor, state: Tensor) -> Any:
    return (
        law.limited(sp + torch.eye(1, 1, dtype=torch.float64)[0] * pv[:1], mv_applied),
        state,
        pv[:1],
    )


@pytest.mark.parametrize(("formula", "traces"), [(replaced, 0), (written_in_place, 1), (lacking, 1)])
def test_a_law_is_traced_again_only_if_it_must(
    make_formula: Make, monkeypatch: pytest.MonkeyPatch, formula: Any, traces: int
) -> None:
    decomposed, law = graph._decomposed, make_formula(formula, 1, ("a",))
    again: list[Any] = []
    monkeypatch.setattr(graph, "_decomposed", lambda *given: (again.append(given), decomposed(*given))[1])

    def stepped() -> list[np.ndarray]:
        graph._translated.cache_clear()
        session = onnxruntime.InferenceSession(law_graph(law)[0].SerializeToString())
        draw = np.random.default_rng(1).uniform
        steps = [{given.name: draw(size=given.shape) for given in session.get_inputs()} for _ in range(20)]
        return [np.concatenate(session.run(None, step)) for step in steps]

    ours = stepped()
    assert len(again) == traces
    monkeypatch.setattr(graph, "_decomposed_if_needed", graph._decomposed)
    np.testing.assert_array_equal(ours, stepped())
    assert len(again) == traces + 1
