"""Prints a program as one FUNCTION_BLOCK in LREAL that keeps the law's state."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from loopwright.pipeline.export.plain_code.layout import (
    COUNTERS,
    EXTREMES,
    INFIX,
    OWN,
    ROUND_COUNTERS,
    PrintedLayout,
    terms_of,
)
from loopwright.pipeline.export.plain_code.memory import WORK
from loopwright.pipeline.export.plain_code.rounds import Block, depth
from loopwright.pipeline.export.plain_code.statements import Place, PlainProgram, PlainStatement
from loopwright.pipeline.export.structured_text.elementary_functions import function_name, parameters
from loopwright.pipeline.export.structured_text.iec_names import array_of, typed

_COMPARED = {"less": "<", "less_equal": "<=", "greater": ">", "greater_equal": ">=", "equal": "="}
_ROUND = [f"at_{name}" for name in ROUND_COUNTERS]
_ONE, _ZERO = typed(1.0), typed(0.0)


@dataclass(frozen=True, slots=True)
class StepBlock:
    """The text of ``NAME_step``, and what it takes."""

    text: str
    program: PlainProgram  # as it is printed, without copies
    inputs: tuple[str, ...]  # of the graph, without the state
    own_functions: tuple[str, ...]  # of elementary
    work_bytes: int  # of its own arrays, in the instance
    table_bytes: int  # of its constants


def printed_step_block(program: PlainProgram, name: str) -> StepBlock:
    """The block ``NAME_step``: FOR loops over arrays, IF for each choice, no function but SQRT and those printed.

    One call is one step. ``state`` stays in the block; ``restart`` begins from ``restart_state`` instead, whose initial
    zeros say that there is no past.
    """
    layout = PrintedLayout.of(program)
    printer = _Printer(layout, name)
    body = [line for b in layout.blocks for line in printer.block(b)]
    n_state = program.inputs.get("state", 0)
    inputs = tuple(n for n, count in program.inputs.items() if count and n != "state")
    outputs = {layout.name(n): count for n, count in program.outputs.items() if count}
    given = [f"    {n} : {_array(program.inputs[n])};" for n in inputs]
    results = [f"    {n} : {_array(count)};" for n, count in outputs.items() if n != "state_next"]
    own = [f"    {n} : {kind};" for n, kind in printer.variables()]
    if n_state:
        given += [
            "    restart : BOOL; (* TRUE: this step begins from restart_state; zeros: no past *)",
            f"    restart_state : {_array(n_state)};",
        ]
        results.append(f"    state : {_array(n_state)}; (* after the step *)")
        own.insert(0, f"    state_next : {_array(n_state)};")
        body = ["IF restart THEN", "    state := restart_state;", "END_IF;", *body, "state := state_next;"]
    tables = list(printer.tables())
    lines = [
        f"FUNCTION_BLOCK {name}_step",
        *("VAR_INPUT", *given, "END_VAR"),
        *("VAR_OUTPUT", *results, "END_VAR"),
        *("VAR", *own, "END_VAR"),
        *(["VAR CONSTANT", *tables, "END_VAR"] if tables else []),
        *body,
        "END_FUNCTION_BLOCK\n",
    ]
    table_bytes = sum(8 * len(v) for _, v in layout.kept()) + sum(4 * len(t) for t in program.tables.values())
    own_functions = tuple(layout.own_functions())
    return StepBlock("\n".join(lines), layout.program, inputs, own_functions, 8 * layout.work_entries, table_bytes)


class _Printer:
    def __init__(self, layout: PrintedLayout, name: str) -> None:
        self.layout, self.name = layout, name
        self.depth = max((len(s.loops) for s in layout.program.statements), default=0)

    def variables(self) -> Iterator[tuple[str, str]]:
        if self.layout.work_entries:
            yield "work", _array(self.layout.work_entries)
        yield "total", "LREAL"
        for k in range(3):
            yield f"given_{k}", "LREAL"
        for d in range(self.depth):
            yield _counter(d), "DINT"
        for d in range(max(map(depth, self.layout.blocks), default=0)):
            yield _ROUND[d], "DINT"

    def tables(self) -> Iterator[str]:
        for name, values in self.layout.kept():
            yield f"    {_table(name)} : {array_of('LREAL', values.tolist())};"
        for name, places in self.layout.program.tables.items():
            yield f"    {_table(name)} : {array_of('DINT', places.tolist())};"

    def block(self, block: Block, around: int = 0) -> Iterator[str]:
        """Rounds within ``around`` others, or a statement."""
        if isinstance(block, PlainStatement):
            yield from self.statement(block)
            return
        yield _loop(_ROUND[around], block.times)
        for inner in block.blocks:
            for line in self.block(inner, around + 1):
                yield f"    {line}"
        yield "END_FOR;"

    def statement(self, s: PlainStatement) -> Iterator[str]:
        indent = ""
        for d, count in enumerate(s.outer):
            yield f"{indent}{_loop(_counter(d), count)}"
            indent += "    "
        made = "total" if s.then else self.entry(s.target)
        lines = list(self.together(s, made) if s.summed else self.each(s.op, made, [self.entry(p) for p in s.args]))
        for k, after in enumerate(s.then, 1):
            args = [self.entry(p) for p in after.args]
            made = "total" if k < len(s.then) else self.entry(s.target)
            lines += self.each(after.op, made, [*args[: after.at], "total", *args[after.at :]])
        for line in lines:
            yield f"{indent}{line}"
        for _ in s.outer:
            indent = indent[:-4]
            yield f"{indent}END_FOR;"

    def each(self, op: str, target: str, args: Sequence[str]) -> Iterator[str]:
        """One entry; a choice is IF, so that no compiler computes what is not chosen."""
        if op in INFIX:
            yield f"{target} := {args[0]} {INFIX[op]} {args[1]};"
        elif op in OWN:
            given = zip(parameters(OWN[op]), args, strict=True)
            words = ", ".join(f"{parameter} := {arg}" for parameter, arg in given)
            yield f"{target} := {function_name(self.name, OWN[op])}({words});"
        elif op in ("copy", "neg", "sqrt"):
            value = {"copy": args[0], "neg": f"-{args[0]}", "sqrt": f"SQRT({args[0]})"}[op]
            yield f"{target} := {value};"
        elif op in _COMPARED:
            yield from _chosen(target, [(f"{args[0]} {_COMPARED[op]} {args[1]}", _ONE)], _ZERO)
        elif op == "not":
            yield from _chosen(target, [(f"{args[0]} = {_ZERO}", _ONE)], _ZERO)
        elif op in ("and", "or"):
            yield from _chosen(target, [(f"({args[0]} <> {_ZERO}) {op.upper()} ({args[1]} <> {_ZERO})", _ONE)], _ZERO)
        elif op == "where":
            yield from _chosen(target, [(f"{args[0]} <> {_ZERO}", args[1])], args[2])
        elif op == "sign":
            yield from _chosen(target, [(f"{args[0]} > {_ZERO}", _ONE), (f"{args[0]} < {_ZERO}", typed(-1.0))], _ZERO)
        else:
            named = [f"given_{k}" for k in range(len(args))]
            for k, arg in enumerate(args):
                yield f"{named[k]} := {arg};"
            yield from _chosen(target, *_of_named(op, named))

    def together(self, s: PlainStatement, target: str) -> Iterator[str]:
        """A sum, a product or an extreme over the summed loops."""
        extreme, outer = EXTREMES.get(s.op), len(s.outer)
        args = [self.entry(p) for p in s.args]
        yield f"total := {self.entry(s.args[0], outer) if extreme else _ZERO};"
        indent = ""
        for d in range(outer, len(s.loops)):
            yield f"{indent}{_loop(_counter(d), s.loops[d])}"
            indent += "    "
        if extreme:
            yield f"{indent}given_0 := {args[0]};"
            test, other = _of_named(extreme, ["total", "given_0"])
            for line in _chosen("total", test, other):
                yield f"{indent}{line}"
        else:
            factor = "" if s.op == "sum" else f" * {args[0 if s.op == 'sum_squares' else 1]}"
            yield f"{indent}total := total + {f'({args[0]}{factor})' if factor else args[0]};"
        for _ in range(outer, len(s.loops)):
            indent = indent[:-4]
            yield f"{indent}END_FOR;"
        added = args[2:] if s.op == "dot" else args[1:] if s.op == "sum" else []
        yield f"{target} := {' + '.join(['total', *added])};"

    def entry(self, place: Place, loops: int | None = None) -> str:
        """Where a place is; with ``loops`` only those counters run, the others stand at 0."""
        values = self.layout.program.constants.get(place.buffer)
        if values is not None and len(values) == 1:
            return typed(float(values[0]))
        terms = terms_of(place, loops, "at_")
        name = "work" if place.buffer == WORK else self.layout.name(place.buffer)
        name = _table(name) if values is not None else name
        at = _sum(place.offset, terms)
        return f"{name}[{_table(place.table)}[{at}]]" if place.table else f"{name}[{at}]"


def _of_named(op: str, x: Sequence[str]) -> tuple[list[tuple[str, str]], str]:
    """Tests with their values, and the value else, of what reads an argument twice; NaN goes as in the interpreter."""
    if op == "abs":
        return [(f"{x[0]} < {_ZERO}", f"-{x[0]}")], x[0]
    if op in ("min", "max"):
        return [(f"{x[0]} {'<' if op == 'min' else '>'} {x[1]}", x[0])], x[1]
    assert op == "clip", op
    return [(f"{x[0]} < {x[1]}", x[1]), (f"{x[0]} > {x[2]}", x[2])], x[0]


def _chosen(target: str, tests: Sequence[tuple[str, str]], other: str) -> Iterator[str]:
    for k, (test, value) in enumerate(tests):
        yield f"{'ELSIF' if k else 'IF'} {test} THEN"
        yield f"    {target} := {value};"
    if other != target:
        yield "ELSE"
        yield f"    {target} := {other};"
    yield "END_IF;"


def _sum(offset: int, terms: Sequence[str]) -> str:
    return " + ".join([*([str(offset)] if offset or not terms else []), *terms])


def _array(count: int) -> str:
    return f"ARRAY[0..{count - 1}] OF LREAL"


def _table(name: str) -> str:
    """The name of a table: ``c12`` alone would be an address in SCL."""
    return f"{'const' if name.startswith('c') else 'place'}_{name[1:]}"


def _counter(depth: int) -> str:
    return f"at_{COUNTERS[depth]}"


def _loop(counter: str, count: int) -> str:
    return f"FOR {counter} := 0 TO {count - 1} DO"
