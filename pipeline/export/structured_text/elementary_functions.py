"""Prints the functions of ``elementary`` as FUNCTIONs, from their Python text, operation by operation."""

from __future__ import annotations

import ast
import inspect
from collections.abc import Iterator
from types import ModuleType
from typing import Any

from loopwright.pipeline.export.plain_code import elementary
from loopwright.pipeline.export.structured_text.iec_names import RESERVED, array_of, lreal, typed

_SIGNS: dict[type[Any], str] = {
    ast.Add: "+", ast.Sub: "-", ast.Mult: "*", ast.Div: "/", ast.FloorDiv: "/", ast.Mod: "MOD",
    ast.Lt: "<", ast.LtE: "<=", ast.Gt: ">", ast.GtE: ">=", ast.NotEq: "<>",
}  # fmt: skip
_KINDS = {"float": "LREAL", "int": "DINT"}


def function_name(name: str, function: str) -> str:
    """Name of the FUNCTION that stands for ``plain_exp`` or another function of ``elementary``."""
    return f"{name}_{function.removeprefix('plain_')}"


def parameters(function: str, module: ModuleType = elementary) -> list[str]:
    """The names of its arguments in the text."""
    return [local(name) for name in inspect.signature(getattr(module, function)).parameters]


def printed_function(name: str, function: str, module: ModuleType = elementary) -> str:
    """The FUNCTION of ``elementary.function`` for the controller ``name``."""
    tree = ast.parse(inspect.getsource(getattr(module, function))).body[0]
    assert isinstance(tree, ast.FunctionDef)
    printer = _InText(module, function_name(name, function))
    body = [line for s in tree.body[1:] for line in printer.statement(s, "")]
    if body[-1] == "RETURN;":
        body.pop()
    variables = [f"    {local(n)} : {kind};" for n, kind in printer.variables.items()]
    constants = [f"    {constant(n)} : {_constant(getattr(module, n))};" for n in printer.constants]
    given = [f"    {a} : LREAL;" for a in parameters(function, module)]
    return "\n".join(
        [
            f"(* {ast.get_docstring(tree)} *)",
            f"FUNCTION {printer.name} : LREAL",
            *("VAR_INPUT", *given, "END_VAR"),
            *("VAR", *variables, "END_VAR"),
            *("VAR CONSTANT", *constants, "END_VAR"),
            *body,
            "END_FUNCTION\n",
        ]
    )


def local(name: str) -> str:
    """A variable's name: no single letter, which is an address or a prefix somewhere, and no word of a language."""
    return 2 * name if len(name) == 1 else f"{name}_part" if name in RESERVED else name


def constant(name: str) -> str:
    """A constant's name, which must not be that of a standard function."""
    return f"c_{name.lower()}"


def _constant(value: Any) -> str:
    return f"LREAL := {lreal(value)}" if isinstance(value, float) else array_of("LREAL", value)


class _InText:
    """One function; what it knows of Python is what ``elementary`` uses."""

    def __init__(self, module: ModuleType, name: str) -> None:
        self.module, self.name = module, name
        self.constants: dict[str, None] = {}
        self.variables: dict[str, str] = {}

    def statement(self, s: ast.stmt, indent: str) -> Iterator[str]:
        if isinstance(s, ast.AnnAssign) and isinstance(s.annotation, ast.Name) and s.value is not None:
            assert isinstance(s.target, ast.Name)
            self.variables[s.target.id] = _KINDS[s.annotation.id]
            yield from self.assigned(self.of(s.target), s.value, indent)
        elif isinstance(s, ast.Assign):
            yield from self.assigned(self.of(s.targets[0]), s.value, indent)
        elif isinstance(s, ast.Return) and s.value is not None:
            yield from self.assigned(self.name, s.value, indent)
            yield f"{indent}RETURN;"
        elif isinstance(s, ast.If) and not s.orelse:
            yield f"{indent}IF {self.of(s.test)} THEN"
            yield from self.block(s.body, indent)
            yield f"{indent}END_IF;"
        elif isinstance(s, ast.For) and isinstance(s.iter, ast.Call) and isinstance(s.iter.args[0], ast.Constant):
            assert isinstance(s.target, ast.Name)
            assert isinstance(s.iter.args[0].value, int)
            self.variables[s.target.id] = "DINT"
            yield f"{indent}FOR {self.of(s.target)} := 0 TO {s.iter.args[0].value - 1} DO"
            yield from self.block(s.body, indent)
            yield f"{indent}END_FOR;"
        else:
            raise NotImplementedError(ast.dump(s))

    def block(self, statements: list[ast.stmt], indent: str) -> Iterator[str]:
        for inner in statements:
            yield from self.statement(inner, indent + "    ")

    def assigned(self, target: str, value: ast.expr, indent: str) -> Iterator[str]:
        """An assignment; a choice becomes IF, since SEL computes both sides."""
        if not isinstance(value, ast.IfExp):
            yield f"{indent}{target} := {self.of(value)};"
            return
        yield f"{indent}IF {self.of(value.test)} THEN"
        yield f"{indent}    {target} := {self.of(value.body)};"
        yield f"{indent}ELSE"
        yield f"{indent}    {target} := {self.of(value.orelse)};"
        yield f"{indent}END_IF;"

    def of(self, e: ast.expr) -> str:
        """An expression; parentheses stand as they stood, so that the order is the same."""
        match e:
            case ast.Name(id=name):
                if hasattr(self.module, name):
                    self.constants[name] = None
                    return constant(name)
                return local(name)
            case ast.Constant(value=value):
                return typed(value) if isinstance(value, float) else str(value)
            case ast.BinOp(left=left, op=op, right=right):
                return f"({self.of(left)} {_SIGNS[type(op)]} {self.of(right)})"
            case ast.UnaryOp(op=ast.USub(), operand=operand):
                return f"(-{self.of(operand)})"
            case ast.Compare(left=left, ops=[op], comparators=[right]):
                return f"{self.of(left)} {_SIGNS[type(op)]} {self.of(right)}"
            case ast.Subscript(value=value, slice=index):
                return f"{self.of(value)}[{self.of(index)}]"
            case ast.Call(func=ast.Name(id="int"), args=[value]):
                return f"LREAL_TO_DINT({self.of(value)})"
        raise NotImplementedError(ast.dump(e))
