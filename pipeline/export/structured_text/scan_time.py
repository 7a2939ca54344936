"""How long a step may take on three kinds of PLC, from operations counted and figures that others published.

These are estimates of an order of magnitude: nothing was run on these processors.
"""

from __future__ import annotations

import ast
import inspect
from dataclasses import dataclass
from functools import cache
from math import prod

from loopwright.pipeline.export.plain_code import elementary
from loopwright.pipeline.export.plain_code.layout import OWN
from loopwright.pipeline.export.plain_code.statements import PlainProgram, PlainStatement

_TWICE = {"dot": 2, "sum_squares": 2, "clip": 2, "sign": 2}  # operations an entry, where it is not one


@dataclass(frozen=True, slots=True)
class StepCounts:
    """A step's work, at most: operations of LREAL, entries of arrays that are read or written, rounds of loops.

    Each operation of a printed function counts as a round, too.
    """

    operations: int
    accesses: int
    rounds: int


@dataclass(frozen=True, slots=True)
class Processor:
    """A PLC and what is published about it: nanoseconds an operation, an access and a round; and where it is said."""

    name: str
    operation_ns: float
    access_ns: float
    round_ns: float
    source: str

    def step_s(self, counts: StepCounts) -> float:
        """Estimated duration of a step [s]."""
        spent = self.operation_ns * counts.operations + self.access_ns * counts.accesses + self.round_ns * counts.rounds
        return 1e-9 * spent


# An access is taken for three fixed-point operations (index, offset, load), a round for two.
PROCESSORS = (
    Processor(
        "Siemens S7-1516-3", 64.0, 3 * 16.0, 2 * 16.0,
        "64 ns a floating-point and 16 ns a fixed-point operation: S7-1500 cycle and response times, A5E03461503-02; "
        "it does not say whether that holds for LREAL",
    ),
    Processor(
        "CODESYS on a Cortex-A9, 1 GHz", 1e3 / 36.753, 0.0, 0.0,
        "36.753 MFLOPS of Linpack in double precision under a just-in-time compiler (Tegra 2): greenecomputing.com",
    ),
    Processor(
        "Beckhoff CX8090", 0.0, 0.0, 2550.0,
        "255 ms for 100,000 rounds of a product of REAL, its conversion and a store: industrialmonitordirect.com, "
        "PLC scan time benchmark",
    ),
)  # fmt: skip


def step_counts(program: PlainProgram) -> StepCounts:
    """Operations, accesses and rounds of a program: the same at each step but for choices, which count whole."""
    done = [(s.op, prod(s.loops)) for s in program.statements]
    done += [(then.op, prod(s.outer)) for s in program.statements for then in s.then]
    each = [(op, rounds * (_of_function(OWN[op]) if op in OWN else 1)) for op, rounds in done]
    return StepCounts(
        sum(rounds * _TWICE.get(op, 1) for op, rounds in each),
        sum(_accesses(s) for s in program.statements),
        sum(rounds for _, rounds in each),
    )


@cache
def _of_function(name: str) -> int:
    """Operations in a call of a printed function, at most: those of its Python text, with both sides of each choice."""

    def of(node: ast.AST) -> int:
        times = 1
        if isinstance(node, ast.For):
            assert isinstance(node.iter, ast.Call)
            assert isinstance(node.iter.args[0], ast.Constant)
            times = int(str(node.iter.args[0].value))
        here = isinstance(node, ast.BinOp | ast.Compare | ast.UnaryOp)
        return times * (here + sum(of(child) for child in ast.iter_child_nodes(node)))

    return of(ast.parse(inspect.getsource(getattr(elementary, name))))


def _accesses(s: PlainStatement) -> int:
    added = {"dot": s.args[2:], "sum": s.args[1:]}.get(s.op, ())
    once = 1 + len(added) + sum(len(then.args) for then in s.then)
    return prod(s.outer) * once + prod(s.loops) * (len(s.args) - len(added))


def estimates(program: PlainProgram) -> list[str]:
    """A line for each processor."""
    counts = step_counts(program)
    return [f"{p.name}: about {_milliseconds(p.step_s(counts))} ms" for p in PROCESSORS]


def _milliseconds(seconds: float) -> str:
    """Two digits: an estimate has no more."""
    text = f"{1e3 * seconds:.2g}"
    return f"{float(text):.0f}" if "e" in text else text
