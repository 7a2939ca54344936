"""torch's exporter without what it does twice, or says to nobody. The only place that touches its internals."""

from __future__ import annotations

import logging
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cache
from operator import getitem
from typing import Any

import torch
from torch._ops import OpOverload
from torch.export import ExportedProgram
from torch.onnx._internal.exporter import _fx_passes
from torch.onnx._internal.exporter._registration import ONNXRegistry

aten = torch.ops.aten
# Operations of laws that ONNX lacks, of two operands: one that does the same, and how it takes them.
_REPLACED: dict[Any, tuple[OpOverload, Callable[..., tuple[tuple[Any, ...], dict[str, Any]]]]] = {
    aten.rsub.Scalar: (aten.sub.Tensor, lambda x, other: ((other, x), {})),
    aten.__and__.Tensor: (aten.bitwise_and.Tensor, lambda x, other: ((x, other), {})),
    aten.to.dtype: (aten._to_copy.default, lambda x, dtype: ((x,), {"dtype": dtype})),
}
_IDENTITY = aten.eye.default  # which the trace writes where a law makes one
_DROPPED = {aten._assert_tensor_metadata.default}  # by the exporter, after
_operators = cache(ONNXRegistry.from_torchlib)
_decomposed = _fx_passes.decompose_with_registry


@contextmanager
def nothing_twice() -> Iterator[None]:
    """Have torch make its table of operators once a process, and trace a program again only if it must.

    The table is only read; anew it takes 0.4 s. The second trace is half of a translation.
    """
    table = vars(ONNXRegistry)["from_torchlib"]
    ONNXRegistry.from_torchlib = staticmethod(_operators)  # type: ignore[method-assign]
    _fx_passes.decompose_with_registry = _decomposed_if_needed
    try:
        yield
    finally:
        ONNXRegistry.from_torchlib = table  # type: ignore[method-assign]
        _fx_passes.decompose_with_registry = _decomposed


def _decomposed_if_needed(exported_program: ExportedProgram, registry: ONNXRegistry) -> ExportedProgram:
    """The program without the operations that ONNX lacks; traced again where it has others than those named here."""
    for node in exported_program.graph.find_nodes(op="call_function", target=_IDENTITY):
        if len(node.args) == 1:
            _spell_out_identity(node)
    calls = [node for node in exported_program.graph.nodes if node.op == "call_function"]
    replaced = [node for node in calls if node.target in _REPLACED and len(node.args) == 2 and not node.kwargs]
    if not all(node in replaced or _kept(node, registry) for node in calls):
        return _decomposed(exported_program, registry)
    for node in replaced:
        node.target, operands = _REPLACED[node.target]
        node.args, node.kwargs = operands(*node.args)
    return exported_program


def _spell_out_identity(node: torch.fx.Node) -> None:
    """Put in place of an identity matrix what torch makes of it when it traces again: where rows meet columns."""
    graph, fake = node.graph, node.meta["val"].fake_mode

    def call(operator: OpOverload, *operands: Any, **more: Any) -> torch.fx.Node:
        made: torch.fx.Node = graph.call_function(operator, operands, more)
        made.meta.update(node.meta)
        with fake:
            made.meta["val"] = operator(
                *(o.meta["val"] if isinstance(o, torch.fx.Node) else o for o in operands), **more
            )
        return made

    counted = {"dtype": torch.uint8, "device": node.meta["val"].device, "pin_memory": False}
    with graph.inserting_before(node):
        rows, columns = (call(aten.arange.default, *node.args, **counted) for _ in range(2))
        met = call(aten.eq.Tensor, call(aten.unsqueeze.default, rows, -1), columns)
        node.replace_all_uses_with(call(aten._to_copy.default, met, dtype=node.meta["val"].dtype))
    graph.erase_node(node)


def _kept(node: torch.fx.Node, registry: ONNXRegistry) -> bool:
    """Whether decomposition leaves an operation alone: ONNX has it, and it writes nothing in place."""
    operator = node.target
    if not isinstance(operator, OpOverload):
        return operator is getitem
    return operator in _DROPPED or (registry.is_registered(operator) and not operator._schema.is_mutable)


@contextmanager
def quiet() -> Iterator[None]:
    """Hold back what the exporter says of torchvision and of its own deprecated calls.

    And what it notes of the place in the sources of each operation: nobody reads it, and it is a third of the tracing.
    """
    log = logging.getLogger("torch.onnx._internal.exporter._registration")
    level, without_places = log.level, torch.fx.config.do_not_emit_stack_traces
    log.setLevel(logging.ERROR)
    torch.fx.config.do_not_emit_stack_traces = True
    try:
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", message=".*isinstance.treespec, LeafSpec.*", category=FutureWarning)
            yield
    finally:
        log.setLevel(level)
        torch.fx.config.do_not_emit_stack_traces = without_places
