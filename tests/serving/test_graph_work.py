"""What the rules of shapes refuse: each would let a graph's work be counted too low, or crash the host."""

from __future__ import annotations

import struct
from typing import Any

import pytest

from loopwright.serving.graph.work import BOOL, DOUBLE, INT64, MAX_RANK, Node, TensorValue, results


def tensor(*shape: int, dtype: int = DOUBLE) -> TensorValue:
    return TensorValue(shape, dtype)


def numbers(*values: int) -> TensorValue:
    """A constant of int64."""
    return TensorValue((len(values),), INT64, struct.pack(f"<{len(values)}q", *values))


def node(op: str, *inputs: TensorValue | None, n_out: int = 1, **attributes: Any) -> Node:
    return Node(op, inputs, attributes, n_out)


M = tensor(2, 3)


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        (node("Reshape", M, numbers(*[1] * 1_001)), "at most 1000 entries"),
        (node("Reshape", M, tensor(2, dtype=INT64)), "it must be a constant"),
        (node("Reshape", M, numbers(2, 2)), "cannot become"),
        (node("Reshape", M, numbers(6, 1, 0)), "has no length for each 0"),
        (node("MatMul", M), "it has 1 inputs; it takes 2 to 2"),
        (node("MatMul", tensor(), M), "multiplies a scalar"),
        (node("MatMul", M, M), "cannot be multiplied"),
        (node("Gemm", tensor(3), M), "must have rank 2"),
        (node("Gemm", M, M), "cannot be multiplied"),
        (node("Concat", M, M), "'axis' is None"),
        (node("Concat", M, M, axis=2), "axis 2 is not within a rank of 2"),
        (node("Concat", M, tensor(2, 3, 1), axis=0), "do not fit together"),
        (node("Add", M, tensor(2, 2)), "do not fit together"),
        (node("ReduceSum", M, numbers(0, 0)), "name one twice"),
        (node("ReduceMax", tensor(0, 3), numbers(0)), "an axis of length 0"),
        (node("Expand", M, numbers(-1)), "hold a negative one"),
        (node("Flatten", M, axis=3), "axis 3 is not within a rank of 2"),
        (node("Slice", M, numbers(0), numbers(1), numbers(0), numbers(0)), "a step is zero"),
        (node("Split", M, n_out=2, axis=1, num_outputs=3), "its attribute says 3"),
        (node("Split", M, n_out=3, axis=0, num_outputs=3), "cannot be split in 3 parts"),
        (node("Split", M, numbers(1, 1), n_out=2, axis=1), "are not those of an axis of 3"),
        (node("Squeeze", M, numbers(0)), "not all of length 1"),
        (node("Tile", M, numbers(2)), "it repeats the shape"),
        (node("Transpose", M, perm=[0, 0]), "none of the axes"),
        (node("Cast", M, to=16), "it casts to type 16"),
        (node("Div", tensor(2, dtype=INT64), numbers(0, 1)), "cast them to double first"),
        (node("Add", M, M, n_out=2), "it must have 1"),
        (node("Unsqueeze", M, numbers(*range(MAX_RANK))), "dimensions"),
    ],
    ids=lambda value: value.op if isinstance(value, Node) else "",
)
def test_an_operator_that_onnx_does_not_allow_is_refused(wrong: Node, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        results(wrong)


@pytest.mark.parametrize(
    ("right", "shapes"),
    [
        (node("Gemm", tensor(3, 2), tensor(4, 3), transA=1, transB=1), [(2, 4)]),
        (node("MatMul", tensor(3), tensor(3, 4)), [(4,)]),
        (node("MatMul", tensor(5, 2, 3), tensor(3)), [(5, 2)]),
        (node("ReduceSum", M), [(1, 1)]),
        (node("ReduceSum", M, None, keepdims=0), [()]),
        (node("ReduceSum", M, noop_with_empty_axes=1), [(2, 3)]),
        (node("ArgMax", M, axis=-1, keepdims=0), [(2,)]),
        (node("Flatten", tensor(2, 3, 4), axis=-1), [(6, 4)]),
        (node("Gather", M, tensor(5, dtype=INT64), axis=1), [(2, 5)]),
        (node("Reshape", M, numbers(0, -1, 1)), [(2, 3, 1)]),
        (node("Slice", M, numbers(-1), numbers(-10), numbers(1), numbers(-1)), [(2, 3)]),
        (node("Slice", M, numbers(1), numbers(9)), [(1, 3)]),
        (node("Split", M, n_out=2, axis=1, num_outputs=2), [(2, 2), (2, 1)]),
        (node("Squeeze", tensor(1, 3, 1)), [(3,)]),
        (node("Unsqueeze", M, numbers(0, -1)), [(1, 2, 3, 1)]),
        (node("Tile", M, numbers(2, 3)), [(4, 9)]),
        (node("Transpose", tensor(2, 3, 4)), [(4, 3, 2)]),
        (node("Where", tensor(1, 3, dtype=BOOL), M, tensor()), [(2, 3)]),
    ],
    ids=lambda value: value.op if isinstance(value, Node) else "",
)
def test_shapes_are_those_of_onnx(right: Node, shapes: list[tuple[int, ...]]) -> None:
    values, work = results(right)
    assert [v.shape for v in values] == shapes
    assert work > 0
