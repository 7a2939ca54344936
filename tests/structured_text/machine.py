"""Runs Structured Text: blark's trees become Python, whose floats are doubles as LREAL is.

What vendors do differently is refused: numbers of two types in one operation, an index outside its array, a name that
is not declared. AND and OR compute both sides, as some compilers do.
"""

from __future__ import annotations

import copy
import math
import re
from collections.abc import Callable, Iterator
from typing import Any

from blark import transform as tree

from structured_text.source import Statement, Unit, stand_in, units_of

ZEROS = {"LREAL": 0.0, "DINT": 0, "INT": 0, "BOOL": False}
COMPARED = {"=": "==", "<>": "!=", "<": "<", "<=": "<=", ">": ">", ">=": ">="}
STANDARD = {"SQRT": "LREAL", "LREAL_TO_DINT": "DINT", "DINT_TO_LREAL": "LREAL"}


class Machine:
    """The blocks of a source text: ``make(NAME)`` is a new instance, ``function(NAME)`` a function."""

    def __init__(self, text: str) -> None:
        self.units = {u.name.lower(): u for u in units_of(text)}
        self.fields: dict[str, dict[str, str]] = {}  # types of the variables of each unit
        self.initial: dict[str, dict[str, Any]] = {}
        self.returns: dict[str, str] = {}
        self.space: dict[str, Any] = {
            "_div": _div,
            "_sqrt": _sqrt,
            "_at": _at,
            "_whole": _whole,
            "_copy": copy.deepcopy,
        }
        for name, unit in self.units.items():
            self._declare(name, unit)
        for unit in self.units.values():
            if unit.kind != "TYPE":
                source = "\n".join(_Compiler(self, unit).lines())
                exec(compile(source, f"<{unit.name}>", "exec"), self.space)

    def make(self, name: str) -> Any:
        """A new instance of a block, a program or a structure."""
        unit = self.units[name.lower()]
        made = Instance()
        for variable, value in self.initial[unit.name.lower()].items():
            kind = self.fields[unit.name.lower()][variable]
            setattr(made, variable, self.make(kind) if kind.lower() in self.units else copy.deepcopy(value))
        if unit.kind != "TYPE":
            made.body = self.space[f"_{unit.name.lower()}"]
        return made

    def function(self, name: str) -> Callable[..., Any]:
        """A FUNCTION as one of Python."""
        found: Callable[..., Any] = self.space[f"_{name.lower()}"]
        return found

    def inputs(self, name: str) -> list[str]:
        """Names of a unit's VAR_INPUT, in their order."""
        blocks = self.units[name.lower()].declarations
        return [v for room, b, listed in blocks if room == "VAR_INPUT" for v, *_ in _variables(b, listed)]

    def _declare(self, name: str, unit: Unit) -> None:
        fields, initial = dict[str, str](), dict[str, Any]()
        for variable, kind, bounds, value in (
            found for _, block, listed in unit.declarations for found in _variables(block, listed)
        ):
            assert variable not in fields, f"{variable} twice in {unit.name}"
            fields[variable] = f"[{kind}]" if bounds else kind
            zero = ZEROS.get(kind)
            if variable in unit.lists:
                initial[variable] = unit.lists[variable]
            elif bounds:
                assert value is None, f"{variable}: its numbers were not read"
                initial[variable] = [zero] * (bounds[1] + 1)
            else:
                initial[variable] = value if value is not None else zero
            given = initial[variable] if bounds else [initial[variable]]
            assert kind not in ZEROS or all(type(v) is type(zero) for v in given), f"{variable} of {unit.name}"
        self.fields[name], self.initial[name] = fields, initial
        if unit.returns is not None:
            self.returns[name] = unit.returns


class Instance:
    """A block's variables; a call runs its body once."""

    body: Callable[[Any], None]

    def __call__(self, **given: Any) -> None:
        for name, value in given.items():
            held = getattr(self, name)
            if isinstance(held, list):
                assert len(held) == len(value)
                held[:] = value
            else:
                setattr(self, name, value)
        type(self).run(self)

    def run(self) -> None:
        self.body(self)


class _Compiler:
    """One function, block or program."""

    def __init__(self, machine: Machine, unit: Unit) -> None:
        self.machine, self.unit, self.name = machine, unit, unit.name.lower()
        self.fields = machine.fields[self.name]
        self.there: dict[str, str] = {}

    def lines(self) -> Iterator[str]:
        if self.unit.kind == "FUNCTION":
            given = self.machine.inputs(self.name)
            yield f"def _{self.name}({', '.join(given)}):"
            space = self.machine.initial[self.name]
            for variable, value in space.items():
                if variable not in given:
                    if isinstance(value, list):
                        self.machine.space[f"_{self.name}_{variable}"] = value
                        yield f"    {variable} = _{self.name}_{variable}"
                    else:
                        yield f"    {variable} = {value!r}"
            yield from self.body()
            yield f"    return {self.name}"
            return
        yield f"def _{self.name}(self):"
        for variable in self.fields:
            yield f"    {variable} = self.{variable}"
        yield from self.body()
        for variable, kind in self.fields.items():
            if kind in ZEROS:
                yield f"    self.{variable} = {variable}"
        yield "    return"

    def body(self) -> Iterator[str]:
        yield from self.block(self.unit.statements, "    ")

    def block(self, statements: tuple[Statement, ...], indent: str) -> Iterator[str]:
        """Statements with their own numbers again."""
        for s in statements:
            self.there = {stand_in(k, n): n for k, n in enumerate(s.numbers)}
            if not s.held:
                yield from [indent + self.again(line) for line in self.statement(s.parsed)]
                continue
            heads = [self.again(head) for head in self.heads(s.parsed)]
            for head, held in zip(heads, s.held, strict=True):
                yield f"{indent}{head}:"
                yield from self.block(held, indent + "    ")
        if not statements:
            yield f"{indent}pass"

    def again(self, text: str) -> str:
        """A text with the numbers that stood in it."""
        return re.sub(r"(?<![A-Za-z\d.])987654\d\d\d(\.5)?(?!\d)", lambda found: self.there[found[0]], text)

    def heads(self, s: Any) -> Iterator[str]:
        """A loop, or the ways of a branch, without what they hold."""
        if isinstance(s, tree.ForStatement):
            i, kind = self.variable(s.control)
            first, last = self.of(s.from_), self.of(s.to)
            assert kind == first[1] == last[1] == "DINT", s
            assert s.step is None
            yield f"for {i} in range({first[0]}, ({last[0]}) + 1)"
        elif isinstance(s, tree.IfStatement):
            yield f"if {self.truth(s.if_expression)}"
            for other in s.else_ifs:
                yield f"elif {self.truth(other.if_expression)}"
            if s.else_clause is not None:
                yield "else"
        else:
            raise NotImplementedError(type(s).__name__)

    def statement(self, s: Any) -> Iterator[str]:
        """A statement that holds no others."""
        if isinstance(s, tree.AssignmentStatement):
            (variable,) = s.variables
            target, kind = self.variable(variable)
            value, given = self.of(s.expression)
            assert kind == given, f"{s}: {kind} := {given}"
            whole = kind.startswith("[")
            yield f"{target}[:] = {value}" if whole else f"{target} = {value}"
        elif isinstance(s, tree.ReturnStatement):
            assert self.unit.kind == "FUNCTION"
            yield f"return {self.name}"
        elif isinstance(s, tree.FunctionCallStatement):
            target, kind = self.variable(s.name)
            fields = self.machine.fields[kind.lower()]
            for p in s.parameters:
                value, given = self.of(p.value)
                name = str(p.name).lower()
                assert fields[name] == given, f"{s}: {name}"
                yield f"{target}.{name}{'[:]' if given.startswith('[') else ''} = {value}"
            yield f"{target}.run()"
        else:
            raise NotImplementedError(type(s).__name__)

    def truth(self, e: Any) -> str:
        value, kind = self.of(e)
        assert kind == "BOOL", e
        return value

    def variable(self, v: Any) -> tuple[str, str]:
        """Text and type of a variable, an entry of an array, or what a block or a structure holds."""
        if isinstance(v, tree.SimpleVariable):
            name = self.again(str(v.name).lower())
            if name == self.name:
                return name, self.machine.returns[name]
            return name, self.fields[name]
        text, kind = self.variable(v.name)
        for element in v.elements:
            if isinstance(element, tree.SubscriptList):
                (subscript,) = element.subscripts
                index, of = self.of(subscript)
                assert kind.startswith("["), v
                assert of == "DINT", v
                text, kind = f"{text}[{f'_at({index})' if '-' in index else index}]", kind[1:-1]
            else:
                field = str(element.field.name).lower()
                text, kind = f"{text}.{field}", self.machine.fields[kind.lower()][field]
        return text, kind

    def of(self, e: Any) -> tuple[str, str]:
        """Text and type of an expression."""
        match e:
            case tree.Real():
                assert "." in str(e.value), f"{e} has no point"
                return str(e.value), "LREAL"
            case tree.Integer():
                return str(e.value), "DINT"
            case tree.Boolean():
                return {"TRUE": "True", "FALSE": "False"}[str(e.value).upper()], "BOOL"
            case tree.ParenthesizedExpression():
                value, kind = self.of(e.expr)
                return f"({value})", kind
            case tree.UnaryOperation():
                value, kind = self.of(e.expr)
                if str(e.op).upper() == "NOT":
                    assert kind == "BOOL", e
                    return f"(not {value})", kind
                assert str(e.op) == "-", e
                assert kind != "BOOL", e
                return f"(-{value})", kind
            case tree.BinaryOperation():
                return self.operation(e)
            case tree.FunctionCall():
                return self.call(e)
            case tree.Variable():
                return self.variable(e)
        raise NotImplementedError(type(e).__name__)

    def operation(self, e: Any) -> tuple[str, str]:
        (left, kind), (right, other), op = self.of(e.left), self.of(e.right), str(e.op).upper()
        assert kind == other, f"{e}: {kind} and {other}"
        if op in ("AND", "OR"):
            assert kind == "BOOL", e
            return f"({left} {'&' if op == 'AND' else '|'} {right})", kind
        if op in COMPARED:
            return f"({left} {COMPARED[op]} {right})", "BOOL"
        assert kind in ("LREAL", "DINT"), e
        if op == "/":
            return (f"_div({left}, {right})" if kind == "LREAL" else f"(_whole({left}) // {right})"), kind
        if op == "MOD":
            assert kind == "DINT", e
            return f"(_whole({left}) % {right})", kind
        assert op in ("+", "-", "*"), op
        return f"({left} {op} {right})", kind

    def call(self, e: Any) -> tuple[str, str]:
        name = str(e.name).upper()
        if name in STANDARD:
            (parameter,) = e.parameters
            value, kind = self.of(parameter.value)
            assert kind == ("DINT" if name == "DINT_TO_LREAL" else "LREAL"), e
            return (
                f"{ {'SQRT': '_sqrt', 'LREAL_TO_DINT': 'round', 'DINT_TO_LREAL': 'float'}[name] }({value})",
                STANDARD[name],
            )
        fields, given = self.machine.fields[name.lower()], []
        for p in e.parameters:
            value, kind = self.of(p.value)
            parameter = str(p.name).lower()
            assert fields[parameter] == kind, f"{e}: {parameter}"
            given.append(f"{parameter}={value}")
        return f"_{name.lower()}({', '.join(given)})", self.machine.returns[name.lower()]


def _variables(block: Any, listed: str = "") -> Iterator[tuple[str, str, tuple[int, int] | None, Any]]:
    """Name, type, bounds of an array, and initial value of what a block of declarations declares."""
    items = block.declarations if isinstance(block, tree.StructureTypeDeclaration) else block.items
    for item in items:
        for declared in item.variables:
            name = listed or str(getattr(declared, "variable", declared)).lower()
            init = getattr(item, "init", None)
            if isinstance(init, tree.ArrayTypeInitialization):
                (part,) = init.spec.subranges
                bounds = (int(str(part.start)), int(str(part.stop)))
                assert bounds[0] == 0, item
                yield name, str(init.spec.type), bounds, init.value
            elif init is None:
                yield name, str(item.spec), None, None
            else:
                yield name, str(init.spec), None, None if init.value is None else _literal(init.value)


def _literal(e: Any) -> Any:
    text = str(e).upper().replace("(", "").replace(")", "").replace("LREAL#", "")
    if text in ("TRUE", "FALSE"):
        return text == "TRUE"
    return float(text) if "." in text else int(text)


def _div(a: float, b: float) -> float:
    """The quotient of IEEE 754."""
    if b:
        return a / b
    return math.nan if a == 0 or a != a else math.copysign(math.inf, a) * math.copysign(1.0, b)


def _sqrt(a: float) -> float:
    return math.sqrt(a) if a >= 0 else math.nan


def _at(index: int) -> int:
    assert index >= 0
    return index


def _whole(number: int) -> int:
    assert number >= 0  # DIV and MOD of negative numbers differ from Python's
    return number
