"""What the audit accepts, every other reader sees in the same way; and it takes a bounded time."""

from __future__ import annotations

import random
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import onnxruntime as ort
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from onnx import TensorProto, helper, numpy_helper
from shipped_files import SHIPPED

from loopwright.serving import ArtifactError
from loopwright.serving.graph.audit import MAX_NODES, MAX_OPSET, MIN_OPSET, audit, graph_values
from loopwright.serving.graph.onnx_bytes import SCHEMA, read_model
from loopwright.serving.graph.operators import SIGNATURES
from loopwright.serving.graph.work import MAX_WORK, RULES

by_name = pytest.mark.parametrize("file", SHIPPED, ids=lambda file: f"{file.parent.name}-{file.stem}")


def as_dict(message: Any) -> dict[str, Any]:
    """What the onnx package reads, in the form of ``read_model``."""

    def value(field: Any, v: Any) -> Any:
        return as_dict(v) if field.type == field.TYPE_MESSAGE else v

    return {
        f.name: [value(f, v) for v in content] if f.is_repeated else value(f, content)
        for f, content in message.ListFields()
    }


def assert_same_for_all(data: bytes) -> None:
    """An accepted file: onnx sees the same fields, and writes the same bytes again."""
    theirs = onnx.ModelProto.FromString(data)
    assert repr(read_model(data)) == repr(as_dict(theirs))  # repr: a NaN equals itself
    assert theirs.SerializeToString(deterministic=True) == data


def accepted(data: bytes) -> bool:
    try:
        audit(data)
    except ArtifactError:
        return False
    assert_same_for_all(data)
    return True


# ---------------------------------------------------------------------- real files
@by_name
def test_a_shipped_file_is_seen_as_others_see_it_and_is_below_the_cap(file: Path) -> None:
    data = file.read_bytes()
    assert accepted(data)
    assert audit(data).work < MAX_WORK / 3


@by_name
def test_shapes_and_types_are_those_that_onnxruntime_computes(file: Path) -> None:
    model = onnx.load(file)
    ours, _ = graph_values(read_model(file.read_bytes())["graph"])
    computed = [name for node in model.graph.node for name in node.output]
    del model.graph.output[:]
    model.graph.output.extend(onnx.ValueInfoProto(name=name) for name in computed)
    session = ort.InferenceSession(model.SerializeToString())
    feed = {i.name: np.ones(i.shape) for i in session.get_inputs()}
    for name, array in zip(computed, session.run(None, feed), strict=True):
        assert ours[name].shape == array.shape, name
        assert ours[name].dtype == helper.np_dtype_to_tensor_dtype(array.dtype), name


# ---------------------------------------------------------------------- the reader's table
@pytest.mark.parametrize("kind", SCHEMA)
def test_the_readers_table_agrees_with_onnxs_own(kind: str) -> None:
    nested = {"Tensor": onnx.TypeProto.Tensor, "Dimension": onnx.TensorShapeProto.Dimension}
    fields = (nested.get(kind) or getattr(onnx, kind)).DESCRIPTOR.fields_by_name
    scalars = {"int64": 3, "int32": 5, "enum": 14, "string": 9, "bytes": 12, "float": 2, "opaque": 11}
    for name, (number, text) in SCHEMA[kind].items():
        theirs, ours = fields[name], text.rstrip("*")
        assert (theirs.number, theirs.is_repeated) == (number, text.endswith("*")), name
        if ours in SCHEMA:
            assert theirs.message_type.name == ours, name
        else:
            assert theirs.type == scalars[ours], name
        assert not theirs.is_packed, name


# ---------------------------------------------------------------------- mutations
def varint(value: int, padding: int = 0) -> bytes:
    """A protobuf number of any size, with ``padding`` needless bytes."""
    groups = [value & 0x7F]
    while value := value >> 7:
        groups.append(value & 0x7F)
    groups += [0] * padding
    return bytes([g | 0x80 for g in groups[:-1]] + groups[-1:])


class Piece:
    """A field: tag, and either fields (a message) or the raw bytes after the tag."""

    def __init__(self, tag: bytes, raw: bytes, inside: list[Piece] | None = None) -> None:
        self.tag, self.raw, self.inside = tag, raw, inside

    def bytes(self) -> bytes:
        if self.inside is None:
            return self.tag + self.raw
        body = b"".join(piece.bytes() for piece in self.inside)
        return self.tag + varint(len(body)) + body


def pieces(message: Any) -> list[Piece]:
    """A message of the onnx package as pieces."""
    result = []
    for field, content in message.ListFields():
        for value in content if field.is_repeated else [content]:
            if field.type == field.TYPE_MESSAGE:
                result.append(Piece(varint(field.number << 3 | 2), b"", pieces(value)))
            elif field.type in (field.TYPE_STRING, field.TYPE_BYTES):
                text = value.encode() if isinstance(value, str) else value
                result.append(Piece(varint(field.number << 3 | 2), varint(len(text)) + text))
            elif field.type == field.TYPE_FLOAT:
                result.append(Piece(varint(field.number << 3 | 5), np.float32(value).tobytes()))
            else:
                result.append(Piece(varint(field.number << 3), varint(value % 2**64)))
    return result


def number_of(tag: bytes) -> int:
    value = 0
    for byte in reversed(tag):
        value = value << 7 | byte & 0x7F
    return value


NUMBERS = [0, 1, 7, 127, 128, 2**31 - 1, 2**31, 2**32 - 1, 2**32 + 1, 2**63 - 1, 2**63, 2**64 - 1, 2**64, 2**69]
Mutation = Callable[[list[Piece], int, random.Random], None]


def high_tag(all_: list[Piece], i: int, rng: random.Random) -> None:
    all_[i].tag = varint(number_of(all_[i].tag) + (1 << rng.choice([32, 33, 34, 35, 40, 60, 63, 64])))


def long_tag(all_: list[Piece], i: int, rng: random.Random) -> None:
    all_[i].tag = varint(number_of(all_[i].tag), rng.randint(1, 9))


def other_wire(all_: list[Piece], i: int, rng: random.Random) -> None:
    all_[i].tag = varint(number_of(all_[i].tag) & ~7 | rng.randrange(8))


def other_number(all_: list[Piece], i: int, rng: random.Random) -> None:
    all_[i].tag = varint(number_of(all_[i].tag) & 7 | rng.choice([0, *range(1, 30), 2**28, 2**29 - 1]) << 3)


def twice(all_: list[Piece], i: int, rng: random.Random) -> None:
    all_.insert(rng.choice([i, len(all_)]), all_[i])


def dropped(all_: list[Piece], i: int, rng: random.Random) -> None:
    del all_[i]


def swapped(all_: list[Piece], i: int, rng: random.Random) -> None:
    j = rng.randrange(len(all_))
    all_[i], all_[j] = all_[j], all_[i]


def stranger(all_: list[Piece], i: int, rng: random.Random) -> None:
    raw = rng.choice([b"\x00", b"\x02ab", b"12345678", varint(rng.choice(NUMBERS)), b""])
    all_.insert(i, Piece(varint(rng.randrange(2**12)), raw))


def grouped(all_: list[Piece], i: int, rng: random.Random) -> None:
    number = rng.choice([99, number_of(all_[i].tag) >> 3])
    all_[i] = Piece(varint(number << 3 | 3), all_[i].bytes() + varint(number << 3 | 4))


def renumbered(all_: list[Piece], i: int, rng: random.Random) -> None:
    all_[i].raw, all_[i].inside = varint(rng.choice(NUMBERS), rng.choice([0, 0, 1, 5])), None


def packed(all_: list[Piece], i: int, rng: random.Random) -> None:
    inside = b"".join(varint(rng.choice(NUMBERS)) for _ in range(rng.randrange(4)))
    all_[i] = Piece(varint(number_of(all_[i].tag) & ~7 | 2), varint(len(inside)) + inside)


def resized(all_: list[Piece], i: int, rng: random.Random) -> None:
    body = all_[i].bytes()[len(all_[i].tag) :]
    all_[i] = Piece(all_[i].tag, body[: rng.randrange(len(body) + 1)] + rng.randbytes(rng.randrange(3)))


def scrambled(all_: list[Piece], i: int, rng: random.Random) -> None:
    body = bytearray(all_[i].bytes())
    body[rng.randrange(len(body))] ^= 1 << rng.randrange(8)
    all_[i] = Piece(b"", bytes(body))


MUTATIONS: list[Mutation] = [
    high_tag, long_tag, other_wire, other_number, twice, dropped, swapped, stranger, grouped, renumbered, packed,
    resized, scrambled,
]  # fmt: skip


def mutated(data: bytes, mutation: Mutation, rng: random.Random) -> bytes:
    """A real file with one field of one message changed, and the lengths around it set right."""
    model = pieces(onnx.ModelProto.FromString(data))
    all_ = model
    while True:
        inner = [p.inside for p in all_ if p.inside]
        if not inner or (all_ is not model and rng.random() < 0.3):
            break
        all_ = rng.choice(inner)
    mutation(all_, rng.randrange(len(all_)), rng)
    return b"".join(piece.bytes() for piece in model)


@pytest.mark.parametrize("mutation", MUTATIONS, ids=lambda m: m.__name__)
def test_a_changed_structure_is_refused_or_seen_the_same_by_all(mutation: Mutation) -> None:
    rng = random.Random(mutation.__name__)
    outcomes = [accepted(mutated(rng.choice(SHIPPED).read_bytes(), mutation, rng)) for _ in range(60)]
    assert False in outcomes
    if mutation in (high_tag, long_tag, grouped):
        assert True not in outcomes


def test_a_changed_byte_is_refused_or_seen_the_same_by_all() -> None:
    rng = random.Random(0)
    outcomes = []
    for file in SHIPPED:
        data = bytearray(file.read_bytes())
        for _ in range(8):
            at, old = rng.randrange(len(data)), 0
            old, data[at] = data[at], rng.randrange(256)
            outcomes.append(accepted(bytes(data)))
            data[at] = old
    assert {True, False} <= set(outcomes)


SMALL = min(SHIPPED, key=lambda file: file.stat().st_size).read_bytes()


@settings(deadline=None, max_examples=150)
@given(
    st.lists(st.tuples(st.integers(0, len(SMALL)), st.integers(0, 12), st.binary(max_size=12)), min_size=1, max_size=3)
)
def test_spliced_bytes_are_refused_or_seen_the_same_by_all(cuts: list[tuple[int, int, bytes]]) -> None:
    data = SMALL
    for at, length, new in cuts:
        data = data[:at] + new + data[at + length :]
    accepted(data)


# ---------------------------------------------------------------------- what a looser reader runs
def model_bytes(nodes: list[Any], shape: list[int], *, constants: dict[str, Any] | None = None) -> bytes:
    """A graph of double ``x`` of a shape to ``y`` of the same."""
    ends = [helper.make_tensor_value_info(name, TensorProto.DOUBLE, shape) for name in ("x", "y")]
    tensors = [numpy_helper.from_array(np.asarray(v), k) for k, v in (constants or {}).items()]
    graph = helper.make_graph(nodes, "g", ends[:1], ends[1:], tensors)
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 18)], ir_version=10)
    return bytes(model.SerializeToString())


def test_a_graph_has_no_more_operators_than_load_in_seconds() -> None:
    names = ["x", *(f"v{k}" for k in range(MAX_NODES - 1)), "y"]
    chain = [helper.make_node("Add", [a, a], [b]) for a, b in pairwise(names)]
    assert audit(model_bytes(chain, [1])).nodes == MAX_NODES
    with pytest.raises(ArtifactError, match="operators; a controller has at most"):
        audit(model_bytes([*chain, helper.make_node("Add", ["y", "y"], ["z"])], [1]))


def hidden(op: str, behind: str, inputs: list[str], constants: dict[str, Any], **attributes: Any) -> bytes:
    """Operator ``op`` written over a harmless one, with tags of which only the lower 32 bits are the field's."""
    plain = model_bytes([helper.make_node(behind, inputs, ["y"])], [1], constants=constants)
    model = pieces(onnx.ModelProto.FromString(plain))
    (graph,) = (p.inside for p in model if p.tag == varint(7 << 3 | 2))
    assert graph
    assert graph[0].inside is not None  # the node
    for piece in pieces(helper.make_node(op, [], [], **attributes)):
        piece.tag = varint(number_of(piece.tag) + (1 << 32))
        graph[0].inside.append(piece)
    return b"".join(piece.bytes() for piece in model)


def hidden_if() -> bytes:
    seven = helper.make_node("Constant", [], ["seven"], value=numpy_helper.from_array(np.array([7.0])))
    end = helper.make_tensor_value_info("seven", TensorProto.DOUBLE, [1])
    branch = helper.make_graph([seven], "branch", [], [end])
    return hidden("If", "Identity", ["yes"], {"yes": np.array(True)}, then_branch=branch, else_branch=branch)


def hidden_loop(trips: int) -> bytes:
    inside = [("i", TensorProto.INT64, []), ("go", TensorProto.BOOL, []), ("v", TensorProto.DOUBLE, [1])]
    outside = [("go_on", TensorProto.BOOL, []), ("doubled", TensorProto.DOUBLE, [1])]
    body = helper.make_graph(
        [helper.make_node("Identity", ["go"], ["go_on"]), helper.make_node("Add", ["v", "v"], ["doubled"])],
        "body",
        [helper.make_tensor_value_info(*end) for end in inside],
        [helper.make_tensor_value_info(*end) for end in outside],
    )
    constants = {"trips": np.array(trips), "yes": np.array(True)}
    return hidden("Loop", "Sum", ["trips", "yes", "x"], constants, body=body)


@pytest.mark.parametrize(("attack", "y"), [(hidden_if(), 7.0), (hidden_loop(3), 8.0)], ids=["If", "Loop"])
def test_an_operator_hidden_behind_a_tag_above_32_bits_is_refused(attack: bytes, y: float) -> None:
    session = ort.InferenceSession(attack)  # the attack is real: onnxruntime runs the hidden operator
    assert session.run(None, {"x": np.ones(1)})[0].tolist() == [y]
    with pytest.raises(ArtifactError, match="which no controller's file has"):
        audit(attack)


def test_a_hidden_loop_without_end_is_refused_before_anything_runs() -> None:
    with pytest.raises(ArtifactError, match="which no controller's file has"):
        audit(hidden_loop(10**10))


def test_a_message_in_two_parts_is_refused() -> None:
    """Protobuf merges them: the second graph's nodes would follow the first one's."""
    data = model_bytes([helper.make_node("Identity", ["x"], ["y"])], [1])
    model = pieces(onnx.ModelProto.FromString(data))
    (graph,) = (p for p in model if p.tag == varint(7 << 3 | 2))
    model.insert(model.index(graph) + 1, Piece(graph.tag, varint(0)))
    with pytest.raises(ArtifactError, match="'graph' twice"):
        audit(b"".join(piece.bytes() for piece in model))


# ---------------------------------------------------------------------- work
def node(op: str, inputs: list[str] = ["x"], **attributes: Any) -> onnx.NodeProto:  # noqa: B006  # only read
    return helper.make_node(op, inputs, ["y"], **attributes)


def bomb_of_products(n: int, times: int) -> bytes:
    names = ["x", *(f"p{i}" for i in range(times - 1)), "y"]
    return model_bytes([helper.make_node("MatMul", [a, a], [b]) for a, b in pairwise(names)], [n, n])


def blown_up(op: str, numbers: list[int]) -> bytes:
    """A value of [1] becomes huge and then small again."""
    chain = [helper.make_node(op, ["x", "n"], ["big"]), helper.make_node("ReduceSum", ["big"], ["y"], keepdims=1)]
    return model_bytes(chain, [1], constants={"n": np.array(numbers)})


@pytest.mark.parametrize(
    "data",
    [
        bomb_of_products(2000, 1),
        bomb_of_products(100, 20_000 // 100),
        blown_up("Tile", [10**7]),
        blown_up("Tile", [2**62]),
        blown_up("Expand", [10**6]),
        blown_up("Expand", [10**5, 10**5]),
        model_bytes([node("Sum", ["x"] * 50_000)], [1000]),
    ],
    ids=["product", "products", "tile", "tile over", "expand", "expand over", "sum"],
)
def test_a_bomb_is_refused(data: bytes) -> None:
    with pytest.raises(ArtifactError, match=r"multiply-adds|one above"):
        audit(data)


def test_work_is_counted_in_multiply_adds() -> None:
    assert audit(bomb_of_products(100, 2)).work == 2 * (100**3 + 32 * 100**2)
    assert audit(model_bytes([node("Add", ["x", "x"])], [10])).work == 32 * 30
    assert audit(model_bytes([node("Transpose", ["x"])], [10])).work == 4 * 20


@pytest.mark.parametrize(
    ("nodes", "message"),
    [
        ([helper.make_node("Cast", ["x"], ["n"], to=7), node("Tile", ["x", "n"])], "it must be a constant"),
        ([helper.make_node("Cast", ["x"], ["n"], to=7), node("Expand", ["x", "n"])], "it must be a constant"),
        ([helper.make_node("Cast", ["x"], ["n"], to=7), node("Reshape", ["x", "n"])], "it must be a constant"),
        ([helper.make_node("Cast", ["x"], ["n"], to=8), node("Identity")], "it casts to type 8"),
        ([node("Identity"), node("Identity")], "'y' twice"),
        ([helper.make_node("Identity", ["y"], ["z"]), node("Identity")], "nothing before it gives"),
        ([helper.make_node("Identity", ["x"], ["z"])], "computed nowhere"),
        ([node("Concat", ["x", "x"], axis=0)], "has not the shape"),
        ([node("Identity", []), node("Identity")], "it has 0 inputs; it takes 1 to 1"),
    ],
)
def test_a_graph_whose_work_cannot_be_known_is_refused(nodes: list[Any], message: str) -> None:
    with pytest.raises(ArtifactError, match=message):
        audit(model_bytes(nodes, [1]))


@pytest.mark.parametrize("op", ["Div", "Mod"])
def test_integers_are_not_divided(op: str) -> None:
    """The smallest integer by -1 overflows, and the processor ends the process."""
    nodes = [
        helper.make_node("Cast", ["x"], ["i"], to=TensorProto.INT64),
        helper.make_node(op, ["i", "n"], ["d"]),
        helper.make_node("Cast", ["d"], ["y"], to=TensorProto.DOUBLE),
    ]
    with pytest.raises(ArtifactError, match="divides integers"):
        audit(model_bytes(nodes, [1], constants={"n": np.array([-1])}))


def lying_shape(model: onnx.ModelProto) -> None:
    model.graph.value_info.append(helper.make_tensor_value_info("big", TensorProto.DOUBLE, [1]))


def lying_dims(model: onnx.ModelProto) -> None:
    model.graph.initializer[0].dims[0] = 2


def open_shape(model: onnx.ModelProto) -> None:
    model.graph.input[0].type.tensor_type.shape.dim[0].dim_param = "n"


def no_shape(model: onnx.ModelProto) -> None:
    model.graph.input[0].type.tensor_type.ClearField("shape")


def two_sets(model: onnx.ModelProto) -> None:
    model.opset_import.append(helper.make_opsetid("com.example", 1))


def input_with_default(model: onnx.ModelProto) -> None:
    model.graph.initializer.append(numpy_helper.from_array(np.ones(1), "x"))


def metadata_twice(model: onnx.ModelProto) -> None:
    model.metadata_props.extend(onnx.StringStringEntryProto(key="k", value=v) for v in "ab")


def attribute_twice(model: onnx.ModelProto) -> None:
    model.graph.node[1].attribute.append(helper.make_attribute("keepdims", 0))


def attribute_of_two_kinds(model: onnx.ModelProto) -> None:
    model.graph.node[1].attribute[0].f = 1.0


def attribute_of_a_function(model: onnx.ModelProto) -> None:
    model.graph.node[1].attribute[0].ref_attr_name = "a"


def tensor_attribute(model: onnx.ModelProto) -> None:
    model.graph.node[1].attribute.append(helper.make_attribute("t", numpy_helper.from_array(np.ones(1))))


def sparse(model: onnx.ModelProto) -> None:
    model.graph.sparse_initializer.append(onnx.SparseTensorProto())


def training(model: onnx.ModelProto) -> None:
    model.training_info.append(onnx.TrainingInfoProto())


def not_quite_true(model: onnx.ModelProto) -> None:
    model.graph.initializer.append(numpy_helper.from_array(np.array([True]), "b"))
    model.graph.initializer[-1].raw_data = b"\2"


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lying_shape, "field 13"),
        (lying_dims, "do not fit together"),
        (open_shape, "field 2"),
        (no_shape, "no fixed shape"),
        (two_sets, "imports the operator sets '', 'com.example'"),
        (input_with_default, "'x' twice"),
        (metadata_twice, "metadata entry twice"),
        (attribute_twice, "'keepdims' twice"),
        (attribute_of_two_kinds, "not of its type"),
        (attribute_of_a_function, "field 21"),
        (tensor_attribute, "field 5"),
        (sparse, "sparse tensors"),
        (training, "training data"),
        (not_quite_true, "truth values"),
    ],
)
def test_what_no_exporter_of_ours_writes_is_refused(change: Callable[[onnx.ModelProto], None], message: str) -> None:
    model = onnx.ModelProto.FromString(blown_up("Tile", [3]))
    assert audit(model.SerializeToString()).ops == {"Tile": 1, "ReduceSum": 1}
    change(model)
    with pytest.raises(ArtifactError, match=message):
        audit(model.SerializeToString())


# ---------------------------------------------------------------------- the rules of shapes
A = np.arange(24.0).reshape(2, 3, 4) + 1
B = A > 3
I2 = np.array([[1, 0, 1]])
Case = tuple[str, list[Any], dict[str, Any], int]


def case(op: str, *inputs: Any, n_out: int = 1, **attributes: Any) -> Case:
    return op, [None if v is None else np.asarray(v) for v in inputs], attributes, n_out


UNARY = sorted(
    {"Abs", "Ceil", "Cos", "Elu", "Exp", "Floor", "Identity", "Log", "Neg", "Reciprocal", "Relu"}
    | {"Round", "Sigmoid", "Sign", "Sin", "Softplus", "Softsign", "Sqrt", "Tanh", "IsNaN", "IsInf", "Softmax"}
)  # fmt: skip
BINARY = ["Add", "Div", "Max", "Min", "Mul", "Pow", "Sub", "Sum"]
COMPARED = ["Equal", "Greater", "GreaterOrEqual", "Less", "LessOrEqual"]
REDUCED = [
    "ReduceL1", "ReduceL2", "ReduceLogSumExp", "ReduceMax", "ReduceMean", "ReduceMin", "ReduceProd", "ReduceSum",
    "ReduceSumSquare",
]  # fmt: skip
FLOAT32_ALONE = ["Atan", "Erf", "HardSigmoid", "LeakyRelu", "Tan"]  # onnxruntime has no double of these
CASES: list[Case] = [
    *(case(op, A) for op in UNARY),
    *(case(op, A.astype(np.float32)) for op in FLOAT32_ALONE),
    *(case(op, A, A[0, :, :1]) for op in (*BINARY, *COMPARED)),
    *(case(op, np.ones((4, 1, 3)), np.ones((2, 1))) for op in (*BINARY, *COMPARED)),
    *(case(op, B, B[:, :1]) for op in ("And", "Or", "Xor")),
    case("Not", B),
    case("Mean", A.astype(np.float32), A[0, :, :1].astype(np.float32)),
    case("Mod", A, [2.0], fmod=1),
    case("Sum", A, A[0], A[:, :1]),
    case("Clip", A, 2.0, 5.0),
    case("Clip", A, None, 5.0),
    case("Where", B[0], A, np.ones((5, 1, 1, 1))),
    *(case("Cast", A, to=to) for to in (1, 6, 7, 9, 11)),
    case("ArgMax", A, axis=1, keepdims=0),
    case("ArgMin", A),
    case("CumSum", A, 1),
    *(case(op, A, [-1], keepdims=0) for op in REDUCED),
    *(case(op, A, [0, 2], keepdims=1) for op in REDUCED),
    *(case(op, A, keepdims=0) for op in REDUCED),
    *(case(op, A, noop_with_empty_axes=1) for op in REDUCED if op != "ReduceLogSumExp"),
    case("ReduceSum", A, None, keepdims=1),
    case("ReduceSum", A, np.zeros(0, int), keepdims=0),
    case("Concat", A, A[:, :1], axis=1),
    case("Concat", A, A, A, axis=-1),
    case("Expand", A[:, :1], [5, 1, 3, 1]),
    case("Flatten", A),
    case("Flatten", A, axis=0),
    case("Flatten", A, axis=-1),
    case("Gather", A, I2, axis=1),
    case("Gather", A, 1),
    case("GatherElements", A[0], I2, axis=0),
    case("Gemm", np.ones((2, 3)), np.ones((3, 4)), np.ones(4)),
    case("Gemm", np.ones((3, 2)), np.ones((4, 3)), transA=1, transB=1),
    *(case("MatMul", np.ones(a), np.ones(b)) for a, b in [
        ((3,), (3,)), ((2, 3), (3,)), ((3,), (3, 4)), ((2, 3), (3, 4)), ((5, 2, 3), (3, 4)), ((5, 1, 2, 3), (6, 3, 4)),
        ((3,), (5, 3, 4)), ((5, 2, 3), (3,)), ((2, 0), (0, 3)),
    ]),
    *(case("Reshape", A, new) for new in ([24], [-1], [0, -1], [4, 0, 2], [3, 2, 2, -1], [1, 24, 1])),
    case("Reshape", np.zeros((0, 3)), [3, 0], allowzero=1),
    case("Slice", A, [1], [2]),
    case("Slice", A, [0, -3], [2**63 - 1, -1], [2, 1]),
    case("Slice", A, [3], [-(2**63)], [2], [-2]),
    case("Slice", A, [-100], [-200], [2], [-1]),
    case("Slice", A, [100], [0], [2], [-3]),
    case("Slice", A, [3], [1], [-1]),
    case("Slice", A, [0], [4], [2], [3]),
    case("Slice", A, [0], [4], None, None),
    case("Split", A, [1, 3], axis=-1, n_out=2),
    case("Split", A, axis=1, num_outputs=2, n_out=2),
    case("Split", A, num_outputs=2, n_out=2),
    case("Squeeze", A[:1, :, :1], [0]),
    case("Squeeze", A[:1, :, :1]),
    case("Tile", A, [2, 1, 3]),
    case("Tile", A, [0, 1, 3]),
    case("Transpose", A),
    case("Transpose", A, perm=[1, 0, 2]),
    case("Unsqueeze", A, [0, -1]),
    case("Unsqueeze", A, [2]),
]  # fmt: skip


KILLS = [["x", ""], ["x", "", "x"], ["x", "x", ""], ["x", "", ""]]  # inputs with which onnxruntime ends the process


@pytest.mark.parametrize("inputs", KILLS, ids=str)
@pytest.mark.parametrize("op", ["Max", "Mean", "Min", "Sum", "Concat"])
def test_a_variadic_operator_with_an_input_left_out_is_refused(op: str, inputs: list[str]) -> None:
    """onnxruntime 1.20 to 1.32 reads through a null pointer there."""
    with pytest.raises(ArtifactError, match="has no name"):
        audit(model_bytes([node(op, inputs, **({"axis": 0} if op == "Concat" else {}))], [1]))


@pytest.mark.parametrize("opset", range(MIN_OPSET, MAX_OPSET + 1))
@pytest.mark.parametrize("op", sorted(SIGNATURES))
def test_a_signature_is_that_of_onnx(op: str, opset: int) -> None:
    schema, ours = onnx.defs.get_schema(op, opset), SIGNATURES[op]
    assert (ours.least, ours.most) == (schema.min_input, schema.max_input)
    options = [one.option.name for one in schema.inputs]
    assert {options[place] for place in ours.optional} <= {"Optional"}
    kinds = {"INT": int, "FLOAT": float, "INTS": list}
    theirs = {name: kinds[a.type.name] for name, a in schema.attributes.items()}
    assert theirs.items() <= ours.attributes.items()
    assert {name for name in ours.attributes if name not in theirs} <= {"saturate"}  # of Cast since opset 19


@pytest.mark.parametrize(
    ("op", "changed"), [("Max", {"axis": 0}), ("Softmax", {"axis": 0.5}), ("Transpose", {"perm": [0.0]})]
)
def test_an_attribute_that_the_operator_does_not_take_is_refused(op: str, changed: dict[str, Any]) -> None:
    with pytest.raises(ArtifactError, match="the attributes it takes"):
        audit(model_bytes([node(op, ["x"], **changed)], [1]))


def test_every_operator_of_the_list_has_a_case() -> None:
    assert {op for op, *_ in CASES} == set(RULES) == set(SIGNATURES)


@pytest.mark.parametrize(("op", "inputs", "attributes", "n_out"), CASES, ids=lambda v: v if isinstance(v, str) else "")
def test_a_rule_gives_the_shape_and_type_that_onnxruntime_computes(
    op: str, inputs: list[Any], attributes: dict[str, Any], n_out: int
) -> None:
    names = ["" if v is None else f"v{i}" for i, v in enumerate(inputs)]
    tensors = [numpy_helper.from_array(v, name) for name, v in zip(names, inputs, strict=True) if v is not None]
    outputs = [f"y{i}" for i in range(n_out)]
    graph = helper.make_graph([helper.make_node(op, names, outputs, **attributes)], "g", [], [], tensors)
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 18)], ir_version=10)
    ours, _ = graph_values(read_model(model.SerializeToString())["graph"])
    graph.output.extend(onnx.ValueInfoProto(name=name) for name in outputs)
    model.graph.CopyFrom(graph)
    session = ort.InferenceSession(model.SerializeToString())
    for name, array in zip(outputs, session.run(None, {}), strict=True):
        assert ours[name].shape == array.shape
        assert ours[name].dtype == helper.np_dtype_to_tensor_dtype(array.dtype)
