"""A graph's statements, run in Python, do what the file does; their memory is shared by arrays of different lives."""

from __future__ import annotations

import math
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import onnx
import pytest
from identified_models import random_model
from kits import SOME, name
from predictive_loops import law_of
from shipped_files import SHIPPED

from loopwright.pipeline.errors import ExportError
from loopwright.pipeline.export.gate import export
from loopwright.pipeline.export.plain_code.c_text import printed_step
from loopwright.pipeline.export.plain_code.fusing import fused
from loopwright.pipeline.export.plain_code.interpreter import run
from loopwright.pipeline.export.plain_code.lowering import lowered
from loopwright.pipeline.export.plain_code.memory import laid_out, overlaps, without_copies
from loopwright.pipeline.export.plain_code.printed_functions import number
from loopwright.pipeline.export.plain_code.self_test import kit_in_c
from loopwright.pipeline.export.plain_code.statements import Place, PlainStatement
from loopwright.serving import Controller

MOST_STACK = 32 * 1024  # bytes of a shipped file's step


@pytest.mark.parametrize("file", SOME, ids=name)
def test_statements_give_what_the_file_gives(file: Path) -> None:
    program = lowered(onnx.load(file))
    kit = kit_in_c(Controller(file), program)
    assert kit.worst < 1e-9
    assert len(kit.given["sp"]) > 300


@pytest.mark.parametrize("sizes", [(1, 1, 0), (2, 3, 1), (3, 3, 0)])
def test_statements_of_a_law_that_operators_steer(tmp_path: Path, sizes: tuple[int, int, int]) -> None:
    n_y, n_mv, n_dv = sizes
    model = random_model(5, n_y=n_y, n_mv=n_mv, n_dv=n_dv)
    export(law_of(model, horizon=15, operate={}, preview="course"), tmp_path / "law.onnx", case="made", provenance={})
    program = lowered(onnx.load(tmp_path / "law.onnx"))
    assert {"operate", "fresh", "ahead"} <= set(program.inputs)
    assert kit_in_c(Controller(tmp_path / "law.onnx"), program).worst < 1e-9


def test_a_law_with_one_rated_mv_of_two_has_a_text(tmp_path: Path) -> None:
    law = law_of(random_model(5, n_y=2, n_mv=2), horizon=15, mv_rate=(0.3, None))
    export(law, tmp_path / "law.onnx", case="made", provenance={})
    assert not re.search(r"\b(inf|nan)\b", printed_step(lowered(onnx.load(tmp_path / "law.onnx")), "x").definitions)
    for value in (math.inf, math.nan):
        with pytest.raises(ExportError):
            number(value)


@pytest.mark.parametrize("file", SHIPPED, ids=name)
def test_no_two_arrays_of_one_life_share_memory(file: Path) -> None:
    program = fused(without_copies(lowered(onnx.load(file))))
    memory = laid_out(program)
    assert overlaps(program, memory) == []
    assert 8 * memory.size <= MOST_STACK
    assert all(start + program.arrays[n] <= memory.size for n, start in memory.starts.items())
    assert printed_step(program, "x").work_bytes == 8 * memory.size


def test_overlaps_are_found() -> None:
    program = without_copies(lowered(onnx.load(SOME[0])))
    memory = laid_out(program)
    assert overlaps(program, replace(memory, starts=dict.fromkeys(memory.starts, 0)))


@pytest.mark.parametrize("file", SOME[:4], ids=name)
def test_results_made_where_they_are_copied_to_are_the_same(file: Path) -> None:
    program = lowered(onnx.load(file))
    rng = np.random.default_rng(0)
    given = {n: rng.uniform(0.1, 1.0, count) for n, count in program.inputs.items()}
    fewer = without_copies(program)
    assert len(fewer.statements) < len(program.statements)
    plain, same = run(program, **given), run(fewer, **given)
    assert all(np.array_equal(plain[n], same[n], equal_nan=True) for n in plain)


def test_an_operator_that_laws_do_not_use_is_refused() -> None:
    node = onnx.helper.make_node("Sin", ["sp"], ["mv"])
    one = [onnx.helper.make_tensor_value_info(n, onnx.TensorProto.DOUBLE, [1]) for n in ("sp", "mv")]
    model = onnx.helper.make_model(onnx.helper.make_graph([node], "g", one[:1], one[1:]))
    with pytest.raises(ExportError, match="Sin"):
        lowered(model)


def test_loops_that_run_through_the_same_entries_become_one() -> None:
    at = Place("a", 0, (12, 4, 1))
    found = PlainStatement("copy", at, (replace(at, buffer="b"),), (2, 3, 4)).simplified()
    assert found.loops == (24,)
    turned = PlainStatement("copy", at, (Place("b", 0, (1, 2, 6)),), (2, 3, 4)).simplified()
    assert turned.loops == (2, 3, 4)
    summed = PlainStatement("dot", Place("y", 0, (1, 0)), (Place("a", 0, (5, 1)), Place("x", 0, (0, 1))), (1, 5), 1)
    assert summed.simplified().loops == (5,)
    assert summed.simplified().summed == 1
