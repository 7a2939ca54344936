"""Prints a program as one C function without heap, branches or a library but sqrt."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from loopwright.pipeline.export.plain_code.layout import EXTREMES, INFIX, OWN, WIDTH, PrintedLayout
from loopwright.pipeline.export.plain_code.printed_functions import functions_in_c, number
from loopwright.pipeline.export.plain_code.statements import Floats, Place, Places, PlainProgram, PlainStatement

_COMPARED = {"less": "<", "less_equal": "<=", "greater": ">", "greater_equal": ">=", "equal": "=="}
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
    program, memory, own, used = layout.program, layout.memory, layout.own_functions(), layout.operations
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
        *([f"    double w[{memory.size}];"] if memory.size else []),
        *(line for s in program.statements for line in printer.statement(s)),
        "}",
    ]
    return PrintedStep(declaration, "\n".join(lines) + "\n", 8 * memory.size, printer.table_bytes(), program.operations)


class _Printer:
    def __init__(self, layout: PrintedLayout) -> None:
        self.layout, self.program, self.memory = layout, layout.program, layout.memory

    def tables(self) -> Iterator[str]:
        for name, values in self.layout.kept():
            yield _numbers("double", name, values)
        for name, places in self.program.tables.items():
            yield _numbers("unsigned short", name, places)

    def table_bytes(self) -> int:
        return sum(8 * len(v) for _, v in self.layout.kept()) + sum(2 * len(t) for t in self.program.tables.values())

    def statement(self, s: PlainStatement) -> Iterator[str]:
        indent, outer = "    ", len(s.loops) - s.summed
        for d in range(outer):
            yield f"{indent}{_loop(d, s.loops[d])}"
            indent += "    "
        target = self.entry(s.target)
        if not s.summed:
            yield f"{indent}{target} = {_value(s.op, [self.entry(p) for p in s.args])};"
        else:
            yield from self._together(s, target, indent, outer)
        for _ in range(outer):
            indent = indent[:-4]
            yield f"{indent}}}"

    def _together(self, s: PlainStatement, target: str, indent: str, outer: int) -> Iterator[str]:
        extreme = EXTREMES.get(s.op)
        args = [self.entry(p) for p in s.args]
        if not outer:
            yield f"{indent}{{"
            indent += "    "
        if extreme:
            yield f"{indent}double s = {self.entry(s.args[0], outer)};"
        else:
            yield f"{indent}double s = 0.0;"
        at = indent
        for d in range(outer, len(s.loops)):
            yield f"{at}{_loop(d, s.loops[d])}"
            at += "    "
        if extreme:
            yield f"{at}s = plain_{extreme}(s, {args[0]});"
        else:
            yield f"{at}s += {args[0]}{' * ' + args[0 if s.op == 'sum_squares' else 1] if s.op != 'sum' else ''};"
        for _ in range(outer, len(s.loops)):
            at = at[:-4]
            yield f"{at}}}"
        added = args[2:] if s.op == "dot" else args[1:] if s.op == "sum" else []
        yield f"{indent}{target} = {' + '.join(['s', *added])};"
        if not outer:
            yield f"{indent[:-4]}}}"

    def entry(self, place: Place, loops: int | None = None) -> str:
        """Where a place is; with ``loops`` only those counters run, the others stand at 0."""
        values = self.program.constants.get(place.buffer)
        if values is not None and len(values) == 1:
            return number(float(values[0])) if values[0] >= 0 else f"({number(float(values[0]))})"
        start = self.memory.starts.get(place.buffer, 0)
        terms = [f"{s} * {_counter(d)}" if s != 1 else _counter(d) for d, s in enumerate(place.strides[:loops]) if s]
        name = "w" if place.buffer in self.memory.starts else self.layout.name(place.buffer)
        if place.table:
            inner = " + ".join([*terms, *([str(place.offset)] if place.offset or not terms else [])])
            return f"{name}[{f'{start} + ' if start else ''}{place.table}[{inner}]]"
        offset = start + place.offset
        return f"{name}[{' + '.join([*([str(offset)] if offset or not terms else []), *terms])}]"


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


def _counter(depth: int) -> str:
    return "ijklmn"[depth]


def _loop(depth: int, count: int) -> str:
    i = _counter(depth)
    return f"for (int {i} = 0; {i} < {count}; ++{i}) {{"


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
