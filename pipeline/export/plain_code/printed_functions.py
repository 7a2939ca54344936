"""Prints the functions of ``elementary`` in C, from their Python text, operation by operation."""

from __future__ import annotations

import ast
import inspect
from collections.abc import Iterator, Sequence
from math import isfinite
from types import ModuleType
from typing import Any

from loopwright.pipeline.errors import ExportError
from loopwright.pipeline.export.plain_code import elementary

_SIGNS: dict[type[Any], str] = {
    ast.Add: "+", ast.Sub: "-", ast.Mult: "*", ast.Div: "/", ast.FloorDiv: "/", ast.Mod: "%",
    ast.Lt: "<", ast.LtE: "<=", ast.Gt: ">", ast.GtE: ">=", ast.NotEq: "!=",
}  # fmt: skip


def functions_in_c(names: Sequence[str], module: ModuleType = elementary) -> str:
    """Static functions of these names with the constants that they use, C99."""
    texts, used = [], dict[str, None]()
    for name in names:
        tree = ast.parse(inspect.getsource(getattr(module, name))).body[0]
        assert isinstance(tree, ast.FunctionDef)
        printer = _InC(module)
        texts.append("\n".join(printer.function(tree)))
        used |= printer.constants
    lines = [constant_in_c(name, getattr(module, name)) for name in used]
    return "\n".join(lines) + "\n\n" + "\n\n".join(texts) + "\n"


def constant_in_c(name: str, value: float | Sequence[float]) -> str:
    """A constant, or an array of them."""
    if isinstance(value, float):
        return f"static const double {name} = {number(value)};"
    return f"static const double {name}[{len(value)}] = {{{', '.join(number(v) for v in value)}}};"


def number(value: float) -> str:
    """The shortest decimal text that reads back as the same double; ExportError for one that is not finite."""
    if not isfinite(value):
        raise ExportError(f"the law has the constant {value}, which no text stands for; design it with finite numbers")
    return repr(float(value))


class _InC:
    """One function; what it knows of Python is what ``elementary`` uses."""

    def __init__(self, module: ModuleType) -> None:
        self.module = module
        self.constants: dict[str, None] = {}

    def function(self, tree: ast.FunctionDef) -> Iterator[str]:
        words = ast.get_docstring(tree) or ""
        yield f"/* {words} */"
        yield f"static double {tree.name}({', '.join(f'double {a.arg}' for a in tree.args.args)})"
        yield "{"
        for statement in tree.body[1:]:
            yield from self.statement(statement, "    ")
        yield "}"

    def statement(self, s: ast.stmt, indent: str) -> Iterator[str]:
        deeper = indent + "    "
        if isinstance(s, ast.AnnAssign) and isinstance(s.annotation, ast.Name) and s.value is not None:
            kind = {"float": "double", "int": "int"}[s.annotation.id]
            yield f"{indent}{kind} {self.of(s.target)} = {self.of(s.value)};"
        elif isinstance(s, ast.Assign):
            yield f"{indent}{self.of(s.targets[0])} = {self.of(s.value)};"
        elif isinstance(s, ast.Return) and s.value is not None:
            yield f"{indent}return {self.of(s.value)};"
        elif isinstance(s, ast.If):
            yield f"{indent}if ({self.of(s.test)}) {{"
            for inner in s.body:
                yield from self.statement(inner, deeper)
            yield f"{indent}}}"
            assert not s.orelse
        elif isinstance(s, ast.For) and isinstance(s.iter, ast.Call):
            i = self.of(s.target)
            yield f"{indent}for (int {i} = 0; {i} < {self.of(s.iter.args[0])}; ++{i}) {{"
            for inner in s.body:
                yield from self.statement(inner, deeper)
            yield f"{indent}}}"
        else:
            raise NotImplementedError(ast.dump(s))

    def of(self, e: ast.expr) -> str:
        """An expression; parentheses stand as they stood, so that the order is the same."""
        match e:
            case ast.Name(id=name):
                if hasattr(self.module, name):
                    self.constants[name] = None
                return name
            case ast.Constant(value=value):
                return number(value) if isinstance(value, float) else str(value)
            case ast.BinOp(left=left, op=op, right=right):
                return f"({self.of(left)} {_SIGNS[type(op)]} {self.of(right)})"
            case ast.UnaryOp(op=ast.USub(), operand=operand):
                return f"-{self.of(operand)}"
            case ast.Compare(left=left, ops=[op], comparators=[right]):
                return f"{self.of(left)} {_SIGNS[type(op)]} {self.of(right)}"
            case ast.IfExp(test=test, body=body, orelse=orelse):
                return f"({self.of(test)}) ? {self.of(body)} : {self.of(orelse)}"
            case ast.Subscript(value=value, slice=index):
                return f"{self.of(value)}[{self.of(index)}]"
            case ast.Call(func=ast.Name(id="int"), args=[value]):
                return f"(int){self.of(value)}"
        raise NotImplementedError(ast.dump(e))
