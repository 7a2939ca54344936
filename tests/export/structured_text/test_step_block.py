"""The step as Structured Text, read by blark and run from its tree, has the bits of the statements."""

from __future__ import annotations

import inspect
import math
import re
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import pytest
from identified_models import random_model
from kits import SOME, name
from predictive_loops import law_of
from shipped_files import SHIPPED
from structured_text.machine import Machine

from loopwright.pipeline.export.gate import export
from loopwright.pipeline.export.plain_code import elementary
from loopwright.pipeline.export.plain_code.c_text import printed_step
from loopwright.pipeline.export.plain_code.interpreter import run_statement
from loopwright.pipeline.export.plain_code.layout import OWN
from loopwright.pipeline.export.plain_code.lowering import lowered
from loopwright.pipeline.export.plain_code.self_test import kit_in_c
from loopwright.pipeline.export.structured_text.elementary_functions import printed_function
from loopwright.pipeline.export.structured_text.step_block import printed_step_block
from loopwright.serving import Controller

STEPS = 25  # of each kit, spread over it


def wrong_steps(file: Path, changed: tuple[str, str] = ("", "")) -> list[int]:
    """Steps of the kit in which a number of the text's step has other bits than the statements give."""
    program = lowered(onnx.load(file))
    block = printed_step_block(program, "tank")
    text = "\n".join([*(printed_function("tank", f) for f in block.own_functions), block.text])
    step = Machine(re.sub(*changed, text, count=1) if changed[0] else text).make("tank_step")
    kit = kit_in_c(Controller(file), program)
    wrong = []
    for k in range(0, len(kit.given["sp"]), len(kit.given["sp"]) // STEPS):
        given: dict[str, Any] = {n: kit.given[n][k].tolist() for n in block.inputs}
        if "state" in kit.given:
            given |= {"restart": True, "restart_state": kit.given["state"][k].tolist()}
        step(**given)
        got = {n: step.state if n == "state_next" else getattr(step, n) for n, v in kit.ours.items() if v.size}
        wrong += [k for n, v in got.items() if np.array(v).tobytes() != kit.ours[n][k].tobytes()]
    return wrong


STATELESS = next(f for f in SHIPPED if name(f) == "thiosulfate_cstr-inc")


@pytest.mark.parametrize("file", [*SOME, STATELESS], ids=name)
def test_steps_have_the_same_bits(file: Path) -> None:
    assert wrong_steps(file) == []


@pytest.mark.parametrize("sizes", [(1, 1, 0), (2, 3, 1)])
def test_steps_of_a_law_that_operators_steer(tmp_path: Path, sizes: tuple[int, int, int]) -> None:
    n_y, n_mv, n_dv = sizes
    model = random_model(5, n_y=n_y, n_mv=n_mv, n_dv=n_dv)
    export(law_of(model, horizon=15, operate={}, preview="course"), tmp_path / "law.onnx", case="made", provenance={})
    assert wrong_steps(tmp_path / "law.onnx") == []


@pytest.mark.parametrize("file", SHIPPED, ids=name)
def test_no_step_divides_by_zero_overflows_or_makes_a_nan(file: Path) -> None:
    """Some PLCs stop there."""
    program = lowered(onnx.load(file))
    given = kit_in_c(Controller(file), program).given
    steps = len(given["sp"])
    arrays = {n: np.zeros((steps, count)) for n, count in {**program.outputs, **program.arrays}.items()}
    arrays |= {n: np.array(given[n]) for n in program.inputs} | dict(program.constants)
    with np.errstate(divide="raise", over="raise", invalid="raise"):
        for s in program.statements:
            run_statement(s, arrays, program.tables)


def test_both_texts_count_the_same_operations() -> None:
    program = lowered(onnx.load(SOME[0]))
    assert printed_step_block(program, "x").program.operations == printed_step(program, "x").operations


def test_another_digit_and_another_order_of_a_sum_are_found() -> None:
    file = next(f for f in SOME if name(f) == "thiosulfate_cstr-pid")
    assert wrong_steps(file, (r"-1853\.140559963534", "-1853.140559963535"))
    assert wrong_steps(file, (r"FOR at_j := 0 TO 9 DO\n        total := total \+ \(work\[at_j\]",
                              "FOR at_j := 0 TO 9 DO\n        total := total + (work[9 - at_j]"))  # fmt: skip


def test_the_state_stays_in_the_block() -> None:
    file = next(f for f in SOME if name(f) == "thiosulfate_cstr-pid")
    block = printed_step_block(lowered(onnx.load(file)), "tank")
    step = Machine(block.text).make("tank_step")
    first = {"sp": [60.0], "pv": [50.0, 40.0], "mv_applied": [100.0]}
    then = first | {"pv": [51.0, 41.0]}
    step(**first)
    begun = list(step.state)
    step(**then)
    gone_on = list(step.state), list(step.mv)
    step(restart=True, **then)
    assert (step.state, step.mv) != gone_on
    step(restart=True, **first)
    assert step.state == begun
    step(restart=False, **then)
    assert (step.state, step.mv) == gone_on


@pytest.mark.parametrize("function", OWN.values())
def test_functions_have_the_bits_of_their_python_text(function: str) -> None:
    text = printed_function("tank", function)
    printed = Machine(text).function(f"tank_{function.removeprefix('plain_')}")
    rng = np.random.default_rng(0)
    points = [*rng.uniform(-1, 1, 300), *rng.uniform(-25, 25, 300), *rng.uniform(-746, 710, 300), 0.0, 5e-324, 1e300]
    of = getattr(elementary, function)
    others = rng.uniform(0.5, 2.0, len(inspect.signature(of).parameters) - 1).tolist()
    for x in map(float, points):
        assert of(x, *others).hex() == printed(x, *others).hex(), x
    assert math.isnan(printed(math.nan, *others)) == math.isnan(of(math.nan, *others))


def test_what_compilers_do_differently_is_refused() -> None:
    for wrong in ("a := 1;", "a := b[-1];", "a := b[2];", "a := LREAL#1.0 + n;", "c := a;", "n := n / n - n / 2;"):
        text = f"""FUNCTION_BLOCK x_block
VAR
    a : LREAL; b : ARRAY[0..1] OF LREAL; n : DINT := -3;
END_VAR
{wrong}
END_FUNCTION_BLOCK
"""
        with pytest.raises((AssertionError, IndexError, KeyError)):
            Machine(text).make("x_block")()
