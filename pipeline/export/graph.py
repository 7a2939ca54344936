"""A law as a plain ONNX graph: float64 to the last constant, few nodes, nothing of this machine in it."""

from __future__ import annotations

import logging
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import cache, lru_cache
from operator import getitem
from typing import Any, Self

import numpy as np
import onnx
import onnx_ir as ir
import torch
from onnx_ir.passes import common as passes
from onnxscript import optimizer
from torch import nn
from torch._ops import OpOverload
from torch.export import ExportedProgram
from torch.onnx._internal.exporter import _fx_passes
from torch.onnx._internal.exporter._registration import ONNXRegistry

from loopwright.pipeline.errors import ExportError
from loopwright.pipeline.laws.base import ControlLaw
from loopwright.serving.errors import ArtifactError
from loopwright.serving.graph.audit import MAX_IR, audit
from loopwright.serving.manifest import INPUTS

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


# -------------------------------------------------------------------------------------------------- the graph of a law
OPSET = 18  # the exporter's own: no version conversion, and older runtimes read it
OUTPUTS = ("mv", "state_next", "info")


def law_graph(law: ControlLaw) -> tuple[onnx.ModelProto, tuple[str, ...]]:
    """The graph of one step as the law is written, and the inputs that it uses, in the order of the contract.

    Inputs ``sp, pv, dv, mv_applied, state``, of a law that reads them ``operate, fresh, ahead``, and outputs ``mv,
    state_next, info``, all float64 of rank 1; an input that the law does not use and an output of size zero are left
    out.

    Raises ExportError where the law cannot be such a graph.
    """
    return module_graph(law, law.name, example_inputs(law), OUTPUTS)


def module_graph(
    module: nn.Module, name: str, example: tuple[torch.Tensor, ...], outputs: tuple[str, ...]
) -> tuple[onnx.ModelProto, tuple[str, ...]]:
    """The graph of a module of law ``name``, and the inputs that it uses; both ends as of ``law_graph``.

    It takes vectors of the sizes of the ``example``, in the order of the contract, and gives these ``outputs``.
    ExportError where it cannot be such a graph.
    """
    try:
        traced = _Traced.of(module, example, outputs)
        translated, inputs = _translated(traced)
    except ExportError:
        raise
    except Exception as error:  # torch wraps whatever went wrong in exceptions of its own
        raise ExportError(f"law {name!r} cannot be traced: {_cause(error)}") from error
    model = ir.from_proto(_filled(translated, module))
    _simplify(model)
    inputs = tuple(name for name in inputs if any(v.name == name for v in model.graph.inputs))
    proto = ir.to_proto(model)
    proto.ir_version = MAX_IR
    proto.producer_name, proto.producer_version = "loopwright", ""
    del proto.graph.value_info[:], proto.metadata_props[:], proto.graph.metadata_props[:]
    _check(module, name, proto)
    return proto, inputs


def example_inputs(law: ControlLaw) -> tuple[torch.Tensor, ...]:
    """``sp, pv, dv, mv_applied, state`` of the law's sizes, all zero; ``operate`` by its defaults, all ``fresh``.

    A law that reads ``ahead`` has the two before it, too, of size zero where it does not read them; zeros then.
    """
    sizes = (*(len(getattr(law.signals, name)) for name in ("sp", "pv", "dv", "mv")), law.n_state)
    zeros = tuple(torch.zeros(n, dtype=torch.float64) for n in sizes)
    if not law.operate and law.ahead is None:
        return zeros
    defaults = torch.tensor([entry.default for entry in law.operate], dtype=torch.float64)
    steered = (*zeros, defaults, torch.ones(sizes[1] if law.operate else 0, dtype=torch.float64))
    return steered if law.ahead is None else (*steered, torch.zeros(law.ahead.size, dtype=torch.float64))


@dataclass(frozen=True)
class _Traced:
    """A law as torch traces it. Equal to that of another law which differs in its buffers' values alone.

    The text holds every operation, its numbers, and the names and shapes of the buffers; beside
    them only constants can differ, which are compared by value.
    """

    text: str
    constants: bytes
    sizes: tuple[int, ...]
    outputs: tuple[str, ...]
    program: torch.export.ExportedProgram = field(compare=False)

    @classmethod
    def of(cls, module: nn.Module, example: tuple[torch.Tensor, ...], outputs: tuple[str, ...]) -> Self:
        with quiet():
            program = torch.export.export(module, example, strict=False)
        constants = {name: t.numpy() for name, t in program.constants.items() if isinstance(t, torch.Tensor)}
        values = b"".join(f"{n} {t.dtype} {t.shape}".encode() + t.tobytes() for n, t in sorted(constants.items()))
        return cls(str(program), values, tuple(map(len, example)), outputs, program)


@lru_cache(maxsize=16)
def _translated(traced: _Traced) -> tuple[onnx.ModelProto, tuple[str, ...]]:
    """The traced law in ONNX, as long as it is written, and its inputs.

    Most of an export's time goes here, so laws of other seeds share it. The buffers are those of
    the law that came first.
    """
    with quiet(), nothing_twice():
        program = torch.onnx.export(
            traced.program, dynamo=True, external_data=False, verbose=False, optimize=False, opset_version=OPSET
        )
    assert program is not None
    assert program.exported_program is not None
    _restore_floats(program.model, _python_floats(program.exported_program))
    inputs = _name_ends(program.model, traced.sizes, traced.outputs)
    return ir.to_proto(program.model), inputs


def _filled(translated: onnx.ModelProto, law: nn.Module) -> onnx.ModelProto:
    """The graph with the law's own buffers."""
    proto, buffers = onnx.ModelProto(), law.state_dict()
    proto.CopyFrom(translated)
    for tensor in proto.graph.initializer:
        if tensor.name in buffers:
            tensor.CopyFrom(onnx.numpy_helper.from_array(buffers[tensor.name].numpy(), tensor.name))
    return proto


def _python_floats(program: torch.export.ExportedProgram) -> set[float]:
    """Every Python float that stands in the traced law."""
    floats: set[float] = set()

    def walk(value: Any) -> Any:
        if isinstance(value, float):
            floats.add(value)
        return value

    for node in program.graph.nodes:
        torch.fx.node.map_aggregate((node.args, node.kwargs), walk)
    return floats


def _restore_floats(model: ir.Model, floats: set[float]) -> None:
    """Give Python floats their 53 bits back: the exporter writes each as float32 and casts it.

    Without this 0.1 becomes 0.100000001, and ``clamp(min=finfo.tiny)`` clamps at 0.
    """
    with np.errstate(over="ignore", under="ignore"):
        exact: dict[float, set[float]] = {}
        for value in floats:
            exact.setdefault(float(np.float32(value)), set()).add(value)
    for node in model.graph:
        if node.op_type != "Constant" or "value" not in node.attributes:
            continue
        tensor = node.attributes["value"].as_tensor()
        if tensor.dtype != ir.DataType.FLOAT or tensor.shape.numpy() != ():
            continue
        rounded = float(tensor.numpy())
        candidates = exact.get(rounded, {rounded})
        if len(candidates) > 1:
            raise ExportError(
                f"the constants {', '.join(map(repr, sorted(candidates)))} become one number in float32; "
                "keep one of them in a float64 buffer"
            )
        node.attributes["value"] = ir.AttrTensor("value", ir.tensor(np.array(next(iter(candidates)))))


def _name_ends(model: ir.Model, sizes: tuple[int, ...], outputs: tuple[str, ...]) -> tuple[str, ...]:
    """Name inputs and outputs by the contract and drop those of size zero.

    The names are given here, not to the exporter, which confuses an input with an output where a
    law hands one through unchanged.
    """
    graph = model.graph
    passes.OutputFixPass()(model)
    for value, name in zip((*graph.inputs, *graph.outputs), (*INPUTS[: len(sizes)], *outputs), strict=True):
        value.name = name
    for value, size in zip(list(graph.inputs), sizes, strict=True):
        if size == 0:
            graph.inputs.remove(value)
            constant = ir.Value(name=f"no_{value.name}", const_value=ir.tensor(np.zeros(0), name=f"no_{value.name}"))
            ir.convenience.replace_all_uses_with(value, constant)
            graph.initializers[f"no_{value.name}"] = constant
    for value in list(graph.outputs):
        if value.shape is not None and value.shape.numpy() == (0,):
            graph.outputs.remove(value)
    return tuple(name for name, size in zip(INPUTS, sizes, strict=False) if size)


def _simplify(model: ir.Model) -> None:
    """Fold constants and drop what nothing reads.

    Not ``onnxscript.optimizer.optimize``: its rewrite rules take any constant within 1e-8 of zero
    for zero and within 1e-5 of one for one.
    """
    optimizer.fold_constants(model)
    for step in (
        passes.IdentityEliminationPass(),
        passes.LiftConstantsToInitializersPass(lift_all_constants=True, size_limit=0),
        passes.DeduplicateInitializersPass(),
        passes.CommonSubexpressionEliminationPass(),
        passes.RemoveUnusedNodesPass(),
        passes.ClearMetadataAndDocStringPass(),
    ):
        step(model)
    for value in [v for v in model.graph.inputs if not v.uses()]:
        model.graph.inputs.remove(value)


def _check(module: nn.Module, name: str, proto: onnx.ModelProto) -> None:
    """ExportError for what ``check_operators`` refuses, or a changed buffer."""
    check_operators(name, proto)
    buffers = module.state_dict()
    for tensor in proto.graph.initializer:
        value = onnx.numpy_helper.to_array(tensor)
        if tensor.name in buffers and not np.array_equal(value, buffers[tensor.name].numpy(), equal_nan=True):
            raise ExportError(f"law {name!r}: buffer {tensor.name!r} changed on its way into the graph")


def _cause(error: Exception) -> str:
    """The innermost reason's first line, past torch's banner."""
    inner: BaseException = error
    while inner.__cause__ is not None:
        inner = inner.__cause__
    return (str(inner).strip().splitlines() or [type(inner).__name__])[0]


# Behind these a value is no longer a transposed matrix.
RESHAPING = frozenset({"Flatten", "Gather", "Gemm", "MatMul", "Reshape", "Squeeze"})


def check_operators(law: str, proto: onnx.ModelProto) -> None:
    """ExportError for an operator off the list, a transposed product or a float32 value."""
    try:
        audit(proto.SerializeToString())
    except ArtifactError as error:
        raise ExportError(f"law {law!r}: {error}") from error
    products = _transposed_products(proto.graph)
    if products:
        raise ExportError(
            f"law {law!r}: {products[0]} multiplies a transposed matrix, which onnxruntime below 1.26 refuses; "
            "write the product as a sum, (a * b).sum(-1), or keep the matrix transposed in a buffer"
        )
    narrow = {onnx.TensorProto.FLOAT, onnx.TensorProto.FLOAT16, onnx.TensorProto.BFLOAT16}
    casts = [a.i for n in proto.graph.node if n.op_type == "Cast" for a in n.attribute if a.name == "to"]
    if narrow & {*casts, *(t.data_type for t in proto.graph.initializer)}:
        raise ExportError(f"law {law!r} computes in float32 somewhere; make its constants and casts float64")


def _transposed_products(graph: onnx.GraphProto) -> list[str]:
    """Names of the matrix products that onnxruntime may fuse with a Transpose into its own FusedMatMul.

    The Transpose need not stand beside the product: onnxruntime moves it behind operators that have
    transposed operands alone.
    """
    transposed: set[str] = set()
    constants = {tensor.name for tensor in graph.initializer}
    products = []
    for node in graph.node:  # in the order of computation
        operands = set(node.input) - constants - {""}
        if node.op_type == "MatMul" and not transposed.isdisjoint(node.input):
            products.append(node.name)
        drops_axis = any(a.name == "keepdims" and a.i == 0 for a in node.attribute)
        passes_on = operands and operands <= transposed and node.op_type not in RESHAPING and not drops_axis
        if node.op_type == "Transpose" or passes_on:
            transposed.update(node.output)
    return products
