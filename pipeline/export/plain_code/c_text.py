"""Prints a program as one C function without heap, branches or a library but sqrt."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

from loopwright.pipeline.export.plain_code.layout import (
    COUNTERS,
    EXTREMES,
    INFIX,
    OWN,
    ROUND_COUNTERS,
    WIDTH,
    PrintedLayout,
    terms_of,
)
from loopwright.pipeline.export.plain_code.memory import WORK
from loopwright.pipeline.export.plain_code.printed_functions import functions_in_c, number
from loopwright.pipeline.export.plain_code.rounds import Block
from loopwright.pipeline.export.plain_code.statements import Floats, Place, Places, PlainProgram, PlainStatement

SUMS = 4  # of products side by side: an addition waits 3 to 4 cycles for the one before it, and its sums fit registers
_DEEPER = "    "
_COMPARED = {"less": "<", "less_equal": "<=", "greater": ">", "greater_equal": ">=", "equal": "=="}
_WITHOUT_CALL = {*_COMPARED, "neg", "not", "and", "or", "where"}
# Bodies of the small functions, by operation: parameters, result.
_SMALL = {
    "abs": ("double a", "a < 0.0 ? -a : a"),
    "sign": ("double a", "(a > 0.0 ? 1.0 : 0.0) - (a < 0.0 ? 1.0 : 0.0)"),
    "min": ("double a, double b", "a < b ? a : b"),
    "max": ("double a, double b", "a > b ? a : b"),
    "clip": ("double a, double low, double high", "a < low ? low : (a > high ? high : a)"),
}


@dataclass(frozen=True, slots=True)
class PrintedStep:
    """The texts of a step in C, and what it takes."""

    declaration: str  # of the function, without its semicolon
    definitions: str  # static tables and functions, and the function
    work_bytes: int  # of its own arrays, on the stack
    table_bytes: int  # of its constants
    operations: int  # a step, always the same


def printed_step(program: PlainProgram, name: str) -> PrintedStep:
    """The function ``NAME_step``, C99 and C++17: static tables, no heap, no library but sqrt.

    Each statement is a nest of loops as it stands in ``program``. Multiplication and addition are not contracted where
    the compiler keeps to what ``Makefile`` says (``-ffp-contract=off``).
    """
    layout = PrintedLayout.of(program)
    own, used = layout.own_functions(), layout.operations
    printer = _Printer(layout)
    small = [
        f"static double plain_{op}({given})\n{{\n    return {result};\n}}\n"
        for op, (given, result) in _SMALL.items()
        if op in used
    ]
    inputs = [f"const double {n}[{count}]" for n, count in program.inputs.items()]
    outputs = [f"double {layout.name(n)}[{count}]" for n, count in program.outputs.items() if count]
    declaration = f"void {name}_step({', '.join([*inputs, *outputs])})"
    lines = [
        *([functions_in_c(own)] if own else []),
        *small,
        *printer.tables(),
        "",
        declaration,
        "{",
        *([f"    double {WORK}[{layout.work_entries}];"] if layout.work_entries else []),
        *(line for b in layout.blocks for line in printer.block(b, "    ")),
        "}",
    ]
    text = "\n".join(lines) + "\n"
    return PrintedStep(declaration, text, 8 * layout.work_entries, printer.table_bytes(), layout.program.operations)


class _Printer:
    def __init__(self, layout: PrintedLayout) -> None:
        self.layout, self.program = layout, layout.program

    def tables(self) -> Iterator[str]:
        for name, values in self.layout.kept():
            yield _numbers("double", name, values)
        for name, places in self.program.tables.items():
            yield _numbers("unsigned short", name, places)

    def table_bytes(self) -> int:
        return sum(8 * len(v) for _, v in self.layout.kept()) + sum(2 * len(t) for t in self.program.tables.values())

    def block(self, block: Block, indent: str, around: int = 0) -> Iterator[str]:
        """Rounds within ``around`` others, or a statement."""
        if isinstance(block, PlainStatement):
            yield from self.statement(block, indent)
            return
        yield f"{indent}{_loop(ROUND_COUNTERS[around], block.times)}"
        for inner in block.blocks:
            yield from self.block(inner, indent + _DEEPER, around + 1)
        yield f"{indent}}}"

    def statement(self, s: PlainStatement, indent: str) -> Iterator[str]:
        beside = s.op == "dot" and bool(s.outer)
        loops = s.outer[:-1] if beside else s.outer
        for d, count in enumerate(loops):
            yield f"{indent}{_loop(COUNTERS[d], count)}"
            indent += _DEEPER
        if beside:
            yield from self.side_by_side(s, indent)
        elif s.summed:
            yield from self.together(s, indent)
        else:
            value = _value(s.op, [self.entry(p) for p in s.args])
            yield f"{indent}{self.entry(s.target)} = {self.then(s, value, s.op)};"
        for _ in loops:
            indent = indent.removesuffix(_DEEPER)
            yield f"{indent}}}"

    def side_by_side(self, s: PlainStatement, indent: str) -> Iterator[str]:
        """The last outer loop some rounds at a time: a processor adds to one sum while it waits for the others."""
        d, count = len(s.outer) - 1, s.outer[-1]
        whole = count - count % SUMS
        if whole > SUMS:
            yield f"{indent}for (int {COUNTERS[d]} = 0; {COUNTERS[d]} < {whole}; {COUNTERS[d]} += {SUMS}) {{"
            yield from self.products([_shifted(s, d, m) for m in range(SUMS)], indent + _DEEPER)
            yield f"{indent}}}"
        for first in range(0 if whole == SUMS else whole, count, SUMS):
            yield f"{indent}{{"
            lanes = range(first, min(first + SUMS, count))
            yield from self.products([_shifted(s, d, m, alone=True) for m in lanes], indent + _DEEPER)
            yield f"{indent}}}"

    def products(self, lanes: Sequence[PlainStatement], indent: str) -> Iterator[str]:
        """Sums of products beside each other, each in its own order."""
        s = lanes[0]
        names = [f"s{m}" for m in range(len(lanes))] if len(lanes) > 1 else ["s"]
        yield from (f"{indent}double {name} = 0.0;" for name in names)
        added = [
            f"{name} += {self.entry(lane.args[0])} * {self.entry(lane.args[1])};"
            for name, lane in zip(names, lanes, strict=True)
        ]
        yield from _summed(s, added, indent)
        for name, lane in zip(names, lanes, strict=True):
            yield f"{indent}{self.entry(lane.target)} = {self.finished(lane, name)};"

    def together(self, s: PlainStatement, indent: str) -> Iterator[str]:
        """A sum or an extreme over the summed loops."""
        if not s.outer:
            yield f"{indent}{{"
            indent += _DEEPER
        extreme, args = EXTREMES.get(s.op), [self.entry(p) for p in s.args]
        yield f"{indent}double s = {self.entry(s.args[0], len(s.outer)) if extreme else '0.0'};"
        factors = [args[0]] * 2 if s.op == "sum_squares" else args[: 2 if s.op == "dot" else 1]
        line = f"s = plain_{extreme}(s, {args[0]});" if extreme else f"s += {' * '.join(factors)};"
        yield from _summed(s, [line], indent)
        yield f"{indent}{self.entry(s.target)} = {self.finished(s, 's')};"
        if not s.outer:
            yield f"{indent.removesuffix(_DEEPER)}}}"

    def finished(self, s: PlainStatement, name: str) -> str:
        """The value to write, from the sum or extreme of that name."""
        added = s.args[2:] if s.op == "dot" else s.args[1:] if s.op == "sum" else ()
        value = " + ".join([name, *map(self.entry, added)])
        return self.then(s, value, "add" if added else "")

    def then(self, s: PlainStatement, value: str, op: str) -> str:
        """``value``, which ``op`` made, after what is done with it."""
        for after in s.then:
            if (op in INFIX or op in _WITHOUT_CALL) and (after.op in INFIX or after.op in _WITHOUT_CALL):
                value = f"({value})"
            others = [self.entry(p) for p in after.args]
            value, op = _value(after.op, [*others[: after.at], value, *others[after.at :]]), after.op
        return value

    def entry(self, place: Place, loops: int | None = None) -> str:
        """Where a place is; with ``loops`` only those counters run, the others stand at 0."""
        values = self.program.constants.get(place.buffer)
        if values is not None and len(values) == 1:
            return number(float(values[0])) if values[0] >= 0 else f"({number(float(values[0]))})"
        terms = terms_of(place, loops)
        name = self.layout.name(place.buffer)
        at = " + ".join([*([str(place.offset)] if place.offset or not terms else []), *terms])
        return f"{name}[{place.table}[{at}]]" if place.table else f"{name}[{at}]"


def _shifted(s: PlainStatement, d: int, by: int, *, alone: bool = False) -> PlainStatement:
    """The same some rounds of loop ``d`` later; ``alone``, outside that loop."""

    def moved(p: Place) -> Place:
        strides = (*p.strides[:d], 0, *p.strides[d + 1 :]) if alone else p.strides
        return replace(p, offset=p.offset + by * p.strides[d], strides=strides)

    return s.at_places(moved)


def _value(op: str, args: Sequence[str]) -> str:
    if op == "copy":
        return args[0]
    if op == "neg":
        return f"-{args[0]}"
    if op == "not":
        return f"{args[0]} == 0.0 ? 1.0 : 0.0"
    if op in INFIX:
        return f"{args[0]} {INFIX[op]} {args[1]}"
    if op in _COMPARED:
        return f"{args[0]} {_COMPARED[op]} {args[1]} ? 1.0 : 0.0"
    if op in ("and", "or"):
        return f"({args[0]} != 0.0) {'&&' if op == 'and' else '||'} ({args[1]} != 0.0) ? 1.0 : 0.0"
    if op == "where":
        return f"{args[0]} != 0.0 ? {args[1]} : {args[2]}"
    if op == "sqrt":
        return f"sqrt({args[0]})"
    return f"{OWN.get(op, f'plain_{op}')}({', '.join(args)})"


def _summed(s: PlainStatement, lines: Sequence[str], indent: str) -> Iterator[str]:
    """The lines within the summed loops of a statement."""
    at = indent
    for d in range(len(s.outer), len(s.loops)):
        yield f"{at}{_loop(COUNTERS[d], s.loops[d])}"
        at += _DEEPER
    for line in lines:
        yield f"{at}{line}"
    while at != indent:
        at = at.removesuffix(_DEEPER)
        yield f"{at}}}"


def _loop(counter: str, count: int) -> str:
    return f"for (int {counter} = 0; {counter} < {count}; ++{counter}) {{"


def _numbers(kind: str, name: str, values: Floats | Places) -> str:
    """A table, its numbers in lines."""
    lines, line = [], "   "
    for value in values.tolist():
        text = f" {number(value) if kind == 'double' else value},"
        if len(line) + len(text) > WIDTH:
            lines.append(line)
            line = "   "
        line += text
    return "\n".join([f"static const {kind} {name}[{len(values)}] = {{", *lines, line, "};"])
