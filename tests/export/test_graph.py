"""Laws that differ in their buffers alone share a translation; nothing else may be shared."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import onnx
import pytest
import torch
from torch import Tensor

from loopwright.pipeline.export import graph
from loopwright.pipeline.export.graph import law_graph
from loopwright.pipeline.laws import ControlLaw

pytest_plugins = ["small_laws"]
Make = Callable[..., ControlLaw]
Drawn = Callable[[int], ControlLaw]


@pytest.fixture(autouse=True)
def _fresh() -> Iterator[None]:
    graph._translated.cache_clear()
    yield
    graph._translated.cache_clear()


def hits() -> int:
    return graph._translated.cache_info().hits


@pytest.fixture
def drawn(make_formula: Make) -> Drawn:
    """A small network of random weights: ``drawn(seed)``."""

    def network(law: Any, sp: Tensor, pv: Tensor, dv: Tensor, mv_applied: Tensor, state: Tensor) -> Any:
        hidden = torch.tanh(torch.cat([sp, pv], dim=-1) @ law.weight * 2.0 + law.bias)
        return law.limited(hidden @ law.out, mv_applied), state + law.folded * 3.0, hidden

    def make(seed: int) -> ControlLaw:
        rng = torch.Generator().manual_seed(seed)
        law = make_formula(network, 1, ("a", "b", "c", "d"))
        shapes = {"weight": (3, 4), "bias": (4,), "out": (4, 1), "folded": (1,)}
        for name, shape in shapes.items():
            law.register_buffer(name, torch.randn(shape, generator=rng, dtype=torch.float64))
        return law

    return make


def constants(proto: onnx.ModelProto) -> set[float]:
    return {float(v) for t in proto.graph.initializer for v in np.ravel(onnx.numpy_helper.to_array(t))}


def test_a_shared_translation_gives_what_its_own_would(drawn: Drawn) -> None:
    alone, inputs = law_graph(drawn(1))
    graph._translated.cache_clear()
    law_graph(drawn(0))
    shared, same = law_graph(drawn(1))
    assert hits() == 1
    assert same == inputs
    assert shared.SerializeToString() == alone.SerializeToString()
    # Also where a buffer was folded into a constant.
    assert float(drawn(1).folded[0]) * 3.0 in constants(shared)
    assert float(drawn(0).folded[0]) * 3.0 not in constants(shared)


def test_numbers_outside_the_buffers_are_not_shared(make_formula: Make) -> None:
    def times(gain: float) -> ControlLaw:
        def formula(law: Any, sp: Tensor, pv: Tensor, dv: Tensor, mv_applied: Tensor, state: Tensor) -> Any:
            return law.limited(gain * sp, mv_applied), state, torch.tensor([gain / 3], dtype=torch.float64) * sp

        return make_formula(formula, 0, ("x",))

    for gain in (0.7, 0.7 + 1e-15, 0.8):
        proto, _ = law_graph(times(gain))
        assert {gain, gain / 3} <= constants(proto)
    assert hits() == 0


def test_constants_made_within_the_law_are_compared_by_value(make_formula: Make) -> None:
    def offset(by: float) -> ControlLaw:
        held = torch.tensor([by], dtype=torch.float64)  # no buffer: the trace lifts it

        def formula(law: Any, sp: Tensor, pv: Tensor, dv: Tensor, mv_applied: Tensor, state: Tensor) -> Any:
            return law.limited(sp + held, mv_applied), state, sp[..., :0]

        return make_formula(formula)

    for by in (0.25, 0.5):
        assert by in constants(law_graph(offset(by))[0])
    assert hits() == 0


def test_another_structure_is_not_shared(make_formula: Make, drawn: Drawn) -> None:
    law_graph(drawn(0))
    wider = drawn(0)
    wider.weight = torch.zeros(3, 5, dtype=torch.float64)
    wider.bias, wider.out = torch.zeros(5, dtype=torch.float64), torch.zeros(5, 1, dtype=torch.float64)
    wider.info = ("a", "b", "c", "d", "e")
    law_graph(wider)
    assert hits() == 0


def test_a_transposed_matrix_may_be_used_outside_matrix_products(make_formula: Make) -> None:
    """Beside a matrix that is not transposed, or summed to a vector first: onnxruntime fuses neither."""

    def formula(law: Any, sp: Tensor, pv: Tensor, dv: Tensor, mv_applied: Tensor, state: Tensor) -> Any:
        outer = pv.unsqueeze(-1) * torch.cat([pv[..., :1], sp], dim=-1)
        turned = outer.transpose(-1, -2)
        return law.limited(sp, sp), state, (outer @ torch.minimum(outer, turned)).sum(-1) + outer @ turned.sum(-1)

    proto, _ = law_graph(make_formula(formula, 0, ("a", "b")))
    assert {"Transpose", "MatMul"} <= {node.op_type for node in proto.graph.node}
