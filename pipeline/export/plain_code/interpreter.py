"""Runs statements in Python: the meaning of a program, by which printed ones are tested."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import reduce
from math import prod
from operator import and_, or_
from typing import Any

import numpy as np

from loopwright.pipeline.export.plain_code.elementary import (
    plain_difference_rest,
    plain_exp,
    plain_exp_rest,
    plain_log,
    plain_quotient,
    plain_tanh,
)
from loopwright.pipeline.export.plain_code.statements import Floats, Place, Places, PlainProgram, PlainStatement


def _each(function: Callable[..., float]) -> Callable[..., Floats]:
    def of_all(*args: Floats) -> Floats:
        same = np.broadcast_arrays(*args)
        found = np.array([function(*values) for values in zip(*(a.ravel().tolist() for a in same), strict=True)])
        return found.reshape(same[0].shape)

    return of_all


def _chosen(of: Callable[..., Any]) -> Callable[..., Floats]:
    return of


def _truth(of: Callable[..., Any]) -> Callable[..., Floats]:
    return lambda *args: np.asarray(of(*args), dtype=np.float64)


# Minima and maxima by comparison, as printed: of equal zeros the second, of a NaN the second.
_MEANING: dict[str, Callable[..., Floats]] = {
    "copy": lambda a: a,
    "neg": lambda a: -a,
    "abs": _chosen(lambda a: np.where(a < 0.0, -a, a)),
    "sign": lambda a: np.asarray(a > 0.0, np.float64) - np.asarray(a < 0.0, np.float64),
    "sqrt": np.sqrt,
    "exp": _each(plain_exp),
    "log": _each(plain_log),
    "tanh": _each(plain_tanh),
    "difference_rest": _each(plain_difference_rest),
    "exp_rest": _each(plain_exp_rest),
    "quotient": _each(plain_quotient),
    "not": _truth(lambda a: a == 0.0),
    "add": lambda a, b: a + b,
    "sub": lambda a, b: a - b,
    "mul": lambda a, b: a * b,
    "div": lambda a, b: a / b,
    "min": _chosen(lambda a, b: np.where(a < b, a, b)),
    "max": _chosen(lambda a, b: np.where(a > b, a, b)),
    "less": _truth(lambda a, b: a < b),
    "less_equal": _truth(lambda a, b: a <= b),
    "greater": _truth(lambda a, b: a > b),
    "greater_equal": _truth(lambda a, b: a >= b),
    "equal": _truth(lambda a, b: a == b),
    "and": _truth(lambda a, b: and_(a != 0.0, b != 0.0)),
    "or": _truth(lambda a, b: or_(a != 0.0, b != 0.0)),
    "where": _chosen(lambda c, a, b: np.where(c != 0.0, a, b)),
    "clip": _chosen(lambda a, low, high: np.where(a < low, low, np.where(a > high, high, a))),
}


def run_statement(statement: PlainStatement, arrays: Mapping[str, Floats], tables: Mapping[str, Places]) -> None:
    """Do one statement on ``arrays`` (..., n), in place: in each of many steps side by side, if there are such."""
    s = statement
    outer, inner = s.outer, s.loops[len(s.outer) :]
    rows = _counters(outer)

    def entries(place: Place, fixed: tuple[int, ...]) -> Places:
        at = place.at(np.hstack([rows, np.tile(np.array(fixed, dtype=np.int64), (len(rows), 1))]))
        return tables[place.table][at] if place.table else at

    def read(place: Place, fixed: tuple[int, ...]) -> Floats:
        return arrays[place.buffer][..., entries(place, fixed)]

    zero = (0,) * s.summed
    if not s.summed:
        result = _MEANING[s.op](*(read(p, ()) for p in s.args))
    else:
        steps = [tuple(int(i) for i in c) for c in _counters(inner)]
        terms = [[read(p, c) for p in s.args[:2]] for c in steps]
        if s.op in ("largest", "least"):
            result = reduce(_MEANING["max" if s.op == "largest" else "min"], (t[0] for t in terms))
        else:
            result = np.zeros(len(rows))
            for t in terms:
                result = result + (t[0] * t[1] if s.op == "dot" else t[0] * t[0] if s.op == "sum_squares" else t[0])
            added = s.args[2:] if s.op == "dot" else s.args[1:]
            if added:
                result = result + read(added[0], zero)
    for after in s.then:
        args = [read(p, zero) for p in after.args]
        result = _MEANING[after.op](*args[: after.at], result, *args[after.at :])
    arrays[s.target.buffer][..., entries(s.target, zero)] = result


def run(program: PlainProgram, **inputs: Floats) -> dict[str, Floats]:
    """The outputs (..., n) by name, from each input (..., n): of one step, or of many side by side."""
    steps = np.broadcast_shapes(*(np.shape(inputs[name])[:-1] for name in program.inputs))
    arrays = {name: np.zeros((*steps, n)) for name, n in {**program.outputs, **program.arrays}.items()}
    arrays |= {name: np.array(inputs[name], dtype=np.float64) for name in program.inputs} | dict(program.constants)
    with np.errstate(all="ignore"):
        for statement in program.statements:
            run_statement(statement, arrays, program.tables)
    return {name: arrays[name] for name in program.outputs}


def _counters(loops: tuple[int, ...]) -> Places:
    """All counters (rounds, loops) of a nest, the last one fastest."""
    found: Places = np.indices(loops, dtype=np.int64).reshape(len(loops), prod(loops)).T
    return found
