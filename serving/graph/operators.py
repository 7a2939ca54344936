"""Inputs and attributes of each operator of a controller: how many, which may be left out, and of which type.

The counts and the attributes are ONNX's, opset 18 to 21. onnxruntime trusts them: where a variadic operator has an
input without a name (``Max(pv, "")``), it reads through a null pointer and ends the process. So an input may be left
out only where ONNX calls it optional and onnxruntime computes without it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

MANY_INPUTS = 2**31 - 1  # inputs of a variadic operator: as many as the work of a step allows


class Signature(NamedTuple):
    """Fewest and most inputs, the places of those that may be left out, and each attribute with its type in Python."""

    least: int
    most: int
    optional: tuple[int, ...] = ()
    attributes: Mapping[str, type] = {}


# fmt: off
_UNARY = (
    "Abs", "Atan", "Ceil", "Cos", "Erf", "Exp", "Floor", "Identity", "IsNaN", "Log", "Neg", "Not", "Reciprocal",
    "Relu", "Round", "Sigmoid", "Sign", "Sin", "Softplus", "Softsign", "Sqrt", "Tan", "Tanh",
)
_BINARY = (
    "Add", "And", "Div", "Equal", "Expand", "Greater", "GreaterOrEqual", "Less", "LessOrEqual", "MatMul", "Mul", "Or",
    "Pow", "Sub", "Tile", "Unsqueeze", "Xor",
)
_REDUCTIONS = (
    "ReduceL1", "ReduceL2", "ReduceLogSumExp", "ReduceMax", "ReduceMean", "ReduceMin", "ReduceProd", "ReduceSum",
    "ReduceSumSquare",
)
# fmt: on
_EXTREME = Signature(1, 1, (), {"axis": int, "keepdims": int, "select_last_index": int})
SIGNATURES: dict[str, Signature] = {
    **dict.fromkeys(_UNARY, Signature(1, 1)),
    **dict.fromkeys(_BINARY, Signature(2, 2)),
    **dict.fromkeys(("Max", "Mean", "Min", "Sum"), Signature(1, MANY_INPUTS)),
    **dict.fromkeys(_REDUCTIONS, Signature(1, 2, (1,), {"keepdims": int, "noop_with_empty_axes": int})),
    **dict.fromkeys(("ArgMax", "ArgMin"), _EXTREME),
    **dict.fromkeys(("Flatten", "Softmax"), Signature(1, 1, (), {"axis": int})),
    **dict.fromkeys(("Elu", "LeakyRelu"), Signature(1, 1, (), {"alpha": float})),
    **dict.fromkeys(("Gather", "GatherElements"), Signature(2, 2, (), {"axis": int})),
    "Cast": Signature(1, 1, (), {"saturate": int, "to": int}),
    "Clip": Signature(1, 3, (1, 2)),
    "Concat": Signature(1, MANY_INPUTS, (), {"axis": int}),
    "CumSum": Signature(2, 2, (), {"exclusive": int, "reverse": int}),
    "Gemm": Signature(2, 3, (2,), {"alpha": float, "beta": float, "transA": int, "transB": int}),
    "HardSigmoid": Signature(1, 1, (), {"alpha": float, "beta": float}),
    "IsInf": Signature(1, 1, (), {"detect_negative": int, "detect_positive": int}),
    "Mod": Signature(2, 2, (), {"fmod": int}),
    "Reshape": Signature(2, 2, (), {"allowzero": int}),
    "Slice": Signature(3, 5, (3, 4)),
    "Split": Signature(1, 2, (), {"axis": int, "num_outputs": int}),
    "Squeeze": Signature(1, 2),
    "Transpose": Signature(1, 1, (), {"perm": list}),
    "Where": Signature(3, 3),
}


def require_signature(op: str, given: Sequence[bool], attributes: Mapping[str, object]) -> None:
    """ValueError where an operator has other inputs or attributes than it takes.

    ``given`` says of each input whether it has a name.
    """
    signature = SIGNATURES[op]
    if not signature.least <= len(given) <= signature.most:
        takes = (
            f"{signature.least} or more" if signature.most == MANY_INPUTS else f"{signature.least} to {signature.most}"
        )
        raise ValueError(f"it has {len(given)} inputs; it takes {takes}")
    for place, is_named in enumerate(given):
        if not is_named and place not in signature.optional:
            raise ValueError(f"its input {place} has no name; the operator computes nothing without it")
    for name, value in attributes.items():
        kind = signature.attributes.get(name)
        whole = not isinstance(value, list) or all(type(v) is int for v in value)
        if type(value) is not kind or not whole:
            takes = ", ".join(f"{key} ({of.__name__})" for key, of in signature.attributes.items()) or "none"
            raise ValueError(f"it has the attribute {name!r} = {str(value)[:40]!r}; the attributes it takes: {takes}")
