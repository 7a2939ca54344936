"""Structured Text as blark's trees: its Earley parser is given a block's declarations and statements one by one.

A list of many numbers takes that parser minutes: of each kind of array it parses a list of two, and here every list is
read number by number, each as a literal of IEC 61131-3. Statements that differ in their numbers alone, those in names
included, are parsed once: the numbers of a statement are taken out of its text, and stand in ``Statement.numbers``. So
are loops and branches that differ in what they hold: each is parsed with ``HELD`` in the place of its statements, which
are parsed by themselves.
"""

from __future__ import annotations

import gc
import re
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from typing import Any

import lark
from blark import transform as tree
from blark.parse import get_parser

LIST = re.compile(r"(?P<name>\w+) : ARRAY\[0\.\.(?P<last>\d+)\] OF (?P<of>\w+) := \[(?P<list>[^\]]*)\];")
ARRAY_TYPE = re.compile(r"^TYPE (?P<name>\w+) : (?P<array>ARRAY\[0\.\.\d+\] OF (?:LREAL|DINT|BOOL));\nEND_TYPE$", re.M)
LITERAL = re.compile(r"-?\d+\.\d+(E[+-]\d\d+)?|-?\d+|TRUE|FALSE")
FIRST = 987654000  # of the numbers that stand for others
WAYS, HELD = re.compile(r"(ELSIF|ELSE)\b"), "it_holds := TRUE;"
BEGINS, ENDS = re.compile(r"(FOR|IF|CASE|WHILE|REPEAT)\b"), re.compile(r"END_(FOR|IF|CASE|WHILE|REPEAT)\b")


@dataclass(frozen=True)
class Statement:
    """blark's statement of a text whose k-th number was replaced by ``stand_in(k, it)``, and the numbers.

    A loop has its statements in ``held``, a branch those of each of its ways.
    """

    parsed: Any
    numbers: tuple[str, ...]
    held: tuple[tuple[Statement, ...], ...]


@dataclass(frozen=True)
class Unit:
    """A function, a block, a program or a structure: blark's declarations and statements, and its long lists."""

    kind: str
    name: str
    returns: str | None  # type of a function
    declarations: tuple[tuple[str, Any, str], ...]  # VAR_INPUT and so on, blark's block of one, the variable's name
    statements: tuple[Statement, ...]
    lists: dict[str, list[float]]


def units_of(text: str) -> list[Unit]:
    """All of a source file, in its order."""
    text = _arrays_in_place(re.sub(r"\(\*.*?\*\)", "", text, flags=re.S))
    found = re.compile(r"^(FUNCTION_BLOCK|FUNCTION|PROGRAM|TYPE)\b[^\n]*\n.*?^END_\1\b;?", re.S | re.M).finditer(text)
    ends, units = 0, []
    for unit in found:
        assert not text[ends : unit.start()].strip(), text[ends : unit.start()]
        ends = unit.end()
        units.append(_unit(unit[0]))
    assert not text[ends:].strip(), text[ends:]
    return units


def _arrays_in_place(text: str) -> str:
    """The text with each array type, which blark reads, in the place of its name."""
    for found in list(ARRAY_TYPE.finditer(text)):
        declared = parsed(found[0].strip(), "iec_source").items[0].declaration
        assert isinstance(declared, tree.ArrayTypeDeclaration)
        assert str(declared.name) == found["name"]
        text = re.sub(rf" : {found['name']}\b", f" : {found['array']}", text.replace(found[0], ""))
    return text


def _unit(text: str) -> Unit:
    lists: dict[str, list[float]] = {}

    def shortened(found: re.Match[str]) -> str:
        texts = [t.strip() for t in found["list"].split(",")]
        assert all(LITERAL.fullmatch(t) for t in texts), found["name"]
        assert len(texts) == int(found["last"]) + 1, found["name"]
        lists[found["name"]] = [t == "TRUE" if t in ("TRUE", "FALSE") else _number(t) for t in texts]
        few = {"LREAL": "-1.5, 2.0E-05", "DINT": "-1, 2", "BOOL": "TRUE, FALSE"}[found["of"]]
        return f"a_name : ARRAY[0..1] OF {found['of']} := [{few}];"

    kind, name, returns = re.match(r"(\w+)\s+(\w+)(?: : (\w+))?", text).groups()  # type: ignore[union-attr]
    if kind == "TYPE":
        structure = parsed(text, "iec_source").items[0].declaration
        return Unit(kind, name, returns, (("STRUCT", structure, ""),), (), {})
    lines = text.splitlines()
    assert lines[0] == f"{kind} {name}{f' : {returns}' if returns else ''}", lines[0]
    last = max((k for k, line in enumerate(lines) if line == "END_VAR"), default=0)
    blocks, room = [], ""
    for line in _declared(lines[1 : last + 1]):
        if line.startswith("VAR"):
            assert not room
            room = line
        elif line == "END_VAR":
            room = ""
        else:
            short = re.sub(r"^\w+ :", "a_name :", LIST.sub(shortened, line))
            whole = f"FUNCTION_BLOCK x_block\n{room}\n{short}\nEND_VAR\n;\nEND_FUNCTION_BLOCK\n"
            (block,) = parsed(whole, "iec_source").items[0].declarations
            blocks.append((room, block, line.split()[0]))
    statements = _statements(lines[last + 1 : -1])
    return Unit(kind, name, returns, tuple(blocks), statements, lists)


def _declared(lines: list[str]) -> Iterator[str]:
    """Whole declarations, and what begins and ends a block of them."""
    held = ""
    for line in lines:
        held += line.strip() if not held else f"\n{line.strip()}"
        if held.startswith("VAR") or held == "END_VAR" or held.rstrip().endswith(";"):
            yield held.rstrip()
            held = ""
    assert not held, held


def stand_in(k: int, number: str) -> str:
    """The number that stands for the k-th of a statement: of the same type, and none that a text has."""
    return f"{FIRST + k}.5" if "." in number else str(FIRST + k)


def _statements(lines: list[str]) -> tuple[Statement, ...]:
    return tuple(_statement(piece) for piece in _pieces(lines))


def _statement(lines: list[str]) -> Statement:
    numbers: list[str] = []

    def taken(found: re.Match[str]) -> str:
        numbers.append(found[0])
        return stand_in(len(numbers) - 1, found[0])

    lines, held = _apart([word for line in lines if (word := line.strip())])
    text = "\n".join(lines) + "\n"
    shape = re.sub(r"(?<![A-Za-z\d.])\d+(\.\d+(E[+-]\d\d+)?)?", taken, text)
    (found,) = parsed(shape, "statement_list").statements
    return Statement(found, tuple(numbers), held)


def _apart(lines: list[str]) -> tuple[list[str], tuple[tuple[Statement, ...], ...]]:
    """A loop or a branch with ``HELD`` in each place of statements, and those; anything else as it is."""
    if not BEGINS.match(lines[0]):
        return lines, ()
    heads, held = [lines[0]], [list[str]()]
    depth = 0
    for line in lines[1:-1]:
        if depth == 0 and WAYS.match(line):
            heads.append(line)
            held.append([])
            continue
        depth += bool(BEGINS.match(line)) - bool(ENDS.match(line))
        held[-1].append(line)
    whole = [text for head in heads for text in (head, HELD)]
    return [*whole, lines[-1]], tuple(_statements(body) for body in held)


def _number(text: str) -> float:
    return int(text) if re.fullmatch(r"-?\d+", text) else float(text)


def _pieces(lines: list[str]) -> Iterator[list[str]]:
    """Whole statements."""
    held: list[str] = []
    depth = 0
    for line in lines:
        held.append(line)
        word = line.strip()
        depth += bool(BEGINS.match(word)) - bool(ENDS.match(word))
        if depth == 0 and word.endswith(";"):
            yield held
            held = []
    assert not any(line.strip() for line in held), held


@cache
def parsed(text: str, start: str) -> Any:
    """blark's tree of a text."""
    gc.disable()  # an Earley parser makes many objects at once, and beside torch each collection is slow
    try:
        found = get_parser().parse(text, start=start)
    except lark.exceptions.LarkError as error:
        raise AssertionError(f"blark does not read\n{text}\n{error}") from error
    finally:
        gc.enable()
    return tree.GrammarTransformer([]).transform(found)
