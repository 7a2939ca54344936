"""Fewer statements, and statements in rounds, have the bits of the first ones: shipped files and random graphs."""

from __future__ import annotations

import ctypes
import shutil
import subprocess
from dataclasses import replace
from math import prod
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from kits import SOME, name
from shipped_files import SHIPPED

from loopwright.pipeline.export.plain_code.c_text import printed_step
from loopwright.pipeline.export.plain_code.fusing import fused
from loopwright.pipeline.export.plain_code.interpreter import run
from loopwright.pipeline.export.plain_code.layout import ROUND_COUNTERS, PrintedLayout
from loopwright.pipeline.export.plain_code.lowering import lowered
from loopwright.pipeline.export.plain_code.memory import in_one_memory, laid_out, without_copies
from loopwright.pipeline.export.plain_code.rounds import DEEPEST, RepeatedBlocks, depth, in_rounds, one_by_one
from loopwright.pipeline.export.plain_code.statements import Floats, Place, PlainProgram, PlainStatement

ODD = (0.0, -0.0, 1e300, -1e-300, np.inf, -np.inf, np.nan)
LENGTHS = (1, 2, 3, 4, 5, 9)


def same_bits(one: dict[str, Floats], other: dict[str, Floats]) -> bool:
    """All entries equal, signs of zeros too; a NaN has no bits that a language promises."""
    return all(
        bool(np.all((a.view(np.int64) == b.view(np.int64)) | (np.isnan(a) & np.isnan(b))))
        for a, b in ((one[n], other[n]) for n in one)
    )


def drawn(program: PlainProgram, seed: int, steps: int = 20) -> dict[str, Floats]:
    """Inputs (steps, n), some entries zero of either sign, too large, infinite or NaN."""
    rng, found = np.random.default_rng(seed), {}
    for n, count in program.inputs.items():
        values = rng.normal(0.0, 3.0, (steps, count))
        odd = rng.random(values.shape) < 0.1
        values[odd] = rng.choice(ODD, int(odd.sum()))
        found[n] = values
    return found


def random_graph(rng: np.random.Generator) -> onnx.ModelProto:
    """Up to 25 nodes on vectors and matrices; results are read once, often or never."""
    nodes: list[onnx.NodeProto] = []
    constants: list[onnx.TensorProto] = []
    tensors: dict[str, tuple[int, ...]] = {"sp": (int(rng.choice(LENGTHS)),), "pv": (int(rng.choice(LENGTHS)),)}
    inputs = dict(tensors)

    def constant(*shape: int) -> str:
        values = rng.choice([*ODD[:2], 1.0, -1.0, *rng.normal(0, 1, 6)], shape)
        constants.append(onnx.numpy_helper.from_array(values, f"k{len(constants)}"))
        return constants[-1].name

    def add(op: str, given: list[str], shape: tuple[int, ...], **attributes: Any) -> None:
        nodes.append(onnx.helper.make_node(op, given, [f"x{len(nodes)}"], **attributes))
        tensors[nodes[-1].output[0]] = shape

    for _ in range(int(rng.integers(3, 26))):
        of = str(rng.choice(list(tensors)[-4:]))
        shape = tensors[of]
        alike = [n for n, s in tensors.items() if s == shape]
        match int(rng.integers(0, 9)):
            case 0 | 1:
                other = constant(*shape) if rng.random() < 0.3 else str(rng.choice(alike))
                pair = [of, other] if rng.random() < 0.5 else [other, of]
                add(str(rng.choice(["Add", "Sub", "Mul", "Div", "Max", "Min"])), pair, shape)
            case 2:
                add(str(rng.choice(["Neg", "Abs", "Sqrt", "Tanh", "Sign"])), [of], shape)
            case 3:
                add("Clip", [of, constant(), constant()], shape)
            case 4:
                columns = int(rng.choice(LENGTHS))
                add("MatMul", [of, constant(shape[-1], columns)], (*shape[:-1], columns))
            case 5:
                rows = int(rng.choice(LENGTHS))
                add("Mul", [of, constant(rows, shape[-1])], (rows, shape[-1])) if len(shape) == 1 else add(
                    "Transpose", [of], shape[::-1]
                )
            case 6:
                shapes = onnx.numpy_helper.from_array(np.array([prod(shape)]), f"k{len(constants)}")
                constants.append(shapes)
                add("Reshape", [of, shapes.name], (prod(shape),))
            case 7:
                other = str(rng.choice(alike))
                add("Concat", [of, other], (*shape[:-1], 2 * shape[-1]), axis=len(shape) - 1)
            case _:
                nodes.append(onnx.helper.make_node("Greater", [of, str(rng.choice(alike))], [f"x{len(nodes)}"]))
                add("Where", [nodes[-1].output[0], of, str(rng.choice(alike))], shape)
    ends = [n for n in tensors if n not in inputs][-2:]
    value = [onnx.helper.make_tensor_value_info(n, onnx.TensorProto.DOUBLE, s) for n, s in inputs.items()]
    results = [onnx.helper.make_tensor_value_info(n, onnx.TensorProto.DOUBLE, tensors[n]) for n in ends]
    return onnx.helper.make_model(onnx.helper.make_graph(nodes, "g", value, results, constants))


@pytest.mark.parametrize("file", SHIPPED, ids=name)
def test_fewer_statements_of_a_shipped_file_have_the_same_bits(file: Path) -> None:
    program = lowered(onnx.load(file))
    fewer = fused(without_copies(program))
    assert len(fewer.statements) < len(program.statements)
    placed = in_one_memory(fewer, laid_out(fewer))
    given_ = drawn(program, 0)
    wanted = run(program, **given_)
    assert same_bits(wanted, run(fewer, **given_))
    assert same_bits(wanted, run(placed, **given_))
    assert tuple(one_by_one(in_rounds(placed.statements))) == placed.statements


@settings(max_examples=100, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_fewer_statements_of_a_random_graph_have_the_same_bits(seed: int) -> None:
    program = lowered(random_graph(np.random.default_rng(seed)))
    fewer = fused(without_copies(program))
    placed = in_one_memory(fewer, laid_out(fewer))
    given_ = drawn(program, seed)
    wanted = run(program, **given_)
    assert same_bits(wanted, run(fewer, **given_))
    assert same_bits(wanted, run(placed, **given_))
    assert tuple(one_by_one(in_rounds(placed.statements))) == placed.statements


def test_random_graphs_have_something_to_fuse() -> None:
    """Else the tests above would say nothing."""
    programs = [without_copies(lowered(random_graph(np.random.default_rng(seed)))) for seed in range(150)]
    then = [t.op for p in programs for s in fused(p).statements for t in s.then]
    assert {"add", "sub", "mul", "div", "clip", "where", "neg", "sqrt"} <= set(then)
    assert any(s.op == "dot" and s.then for p in programs for s in fused(p).statements)


@pytest.mark.skipif(shutil.which("gcc") is None, reason="needs gcc")
@pytest.mark.parametrize("level", ["-O0", "-O3"])
def test_compiled_random_graphs_have_the_bits_of_their_statements(level: str, tmp_path: Path) -> None:
    programs = [lowered(random_graph(np.random.default_rng(seed))) for seed in range(40)]
    texts = [printed_step(p, f"law{k}").definitions for k, p in enumerate(programs)]
    library = {}
    for k, text in enumerate(texts):
        (tmp_path / f"law{k}.c").write_text(f"#include <math.h>\n{text}", encoding="utf-8")
        made = tmp_path / f"law{k}.so"
        flags = ["-std=c99", level, "-Wconversion", "-Werror", "-ffp-contract=off", "-shared", "-fPIC"]
        subprocess.run(["gcc", *flags, tmp_path / f"law{k}.c", "-o", made, "-lm"], check=True)
        library[k] = getattr(ctypes.CDLL(str(made)), f"law{k}_step")
    for k, program in enumerate(programs):
        given_ = drawn(program, k)
        wanted = run(program, **given_)
        got = {n: np.zeros_like(v) for n, v in wanted.items()}
        for row in range(len(given_["sp"])):
            arrays = [*(given_[n][row] for n in program.inputs), *(v[row] for v in got.values())]
            library[k](*(a.ctypes.data_as(ctypes.POINTER(ctypes.c_double)) for a in arrays))
        assert same_bits(wanted, got), k


@pytest.mark.parametrize("file", SOME, ids=name)
def test_both_numbers_of_operations_are_equal(file: Path) -> None:
    """No operation is lost or done twice; copies apart, which go."""
    program = lowered(onnx.load(file))
    copies = sum(s.operations for s in program.statements if s.op == "copy")
    fewer = PrintedLayout.of(program).program
    left = sum(prod(s.loops) for s in fewer.statements if s.op == "copy")
    assert fewer.operations - left == program.operations - copies


def test_rounds_are_found_and_in_them_rounds() -> None:
    def copied(to: int, of: int) -> PlainStatement:
        return PlainStatement("copy", Place("w", to, (1,)), (Place("sp", of, (1,)),), (4,))

    three = [copied(40 + 4 * k, 3 * k) for k in range(3)]
    assert in_rounds(three[:2]) == tuple(three[:2])
    (found,) = in_rounds(three)
    assert isinstance(found, RepeatedBlocks)
    assert found.times == 3
    assert [p.further for b in one_by_one(found.blocks) for p in b.places] == [(4,), (3,)]
    other = PlainStatement("neg", Place("w", 0, (1,)), (Place("w", 4, (1,)),), (4,))
    swept = [s for sweep in range(5) for s in (*(copied(40 + 4 * k, 20 * sweep + k) for k in range(3)), other)]
    (found,) = in_rounds(swept)
    assert isinstance(found, RepeatedBlocks)
    assert found.times == 5
    assert isinstance(found.blocks[0], RepeatedBlocks)
    assert found.blocks[1] == other.at_places(lambda p: replace(p, further=(0,)))
    assert list(one_by_one([found])) == swept
    assert in_rounds([*three[:2], other, three[2]]) == (*three[:2], other, three[2])
    irregular = [*three[:2], copied(60, 6)]
    assert in_rounds(irregular) == tuple(irregular)


def test_rounds_stand_within_each_other_as_deep_as_the_texts_have_counters() -> None:
    sizes = (3, 4, 5, 3, 4)
    counters = np.indices(sizes).reshape(len(sizes), -1).T
    far = counters @ np.array([7**5, 7**4 + 1, 7**3 + 2, 7**2 + 3, 7])
    statements = [PlainStatement("copy", Place("w", int(n), ()), (Place("sp", 0, ()),), ()) for n in far]
    found = in_rounds(statements)
    assert max(map(depth, found)) == DEEPEST == len(ROUND_COUNTERS)
    assert list(one_by_one(found)) == statements


def test_what_is_read_twice_or_in_another_order_stays() -> None:
    def program(*statements: PlainStatement) -> PlainProgram:
        return PlainProgram({"sp": 4}, {"out_mv": 4, "out_info": 4}, {}, {}, {"t0": 4}, statements)

    def at(buffer: str, stride: int = 1, offset: int = 0) -> Place:
        return Place(buffer, offset, (stride,))

    made = PlainStatement("neg", at("t0"), (at("sp"),), (4,))
    once = PlainStatement("mul", at("out_mv"), (at("sp"), at("t0")), (4,))
    assert len(fused(program(made, once)).statements) == 1
    twice = PlainStatement("mul", at("out_mv"), (at("t0"), at("t0")), (4,))
    more = PlainStatement("abs", at("out_info"), (at("t0"),), (4,))
    turned = PlainStatement("abs", at("out_mv"), (at("t0", -1, 3),), (4,))
    called = PlainStatement("tanh", at("out_mv"), (at("t0"),), (4,))
    for rest in ([twice], [once, more], [turned], [called]):
        assert len(fused(program(made, *rest)).statements) == 1 + len(rest)
