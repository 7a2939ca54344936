"""Structured Text as blark's trees: its Earley parser is given a block's declarations and statements one by one.

A list of many numbers takes that parser minutes, so a long one is parsed with its first numbers, and all of them are
read here, each as a literal of IEC 61131-3. Statements that differ in their numbers alone are parsed once: the numbers
of a statement are taken out of its text, and stand in ``Statements.numbers``.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from typing import Any

import lark
from blark import transform as tree
from blark.parse import get_parser

FEW = 4  # numbers of a long list that blark parses
LITERAL = re.compile(r"-?\d+\.\d+(E[+-]\d\d+)?|-?\d+|TRUE|FALSE")
FIRST = 987654000  # of the numbers that stand for others
BEGINS, ENDS = re.compile(r"(FOR|IF|CASE|WHILE|REPEAT)\b"), re.compile(r"END_(FOR|IF|CASE|WHILE|REPEAT)\b")


@dataclass(frozen=True)
class Statements:
    """blark's statements of a text whose k-th number was replaced by ``stand_in(k, it)``, and the numbers."""

    parsed: tuple[Any, ...]
    numbers: tuple[str, ...]


@dataclass(frozen=True)
class Unit:
    """A function, a block, a program or a structure: blark's declarations and statements, and its long lists."""

    kind: str
    name: str
    head: Any
    statements: tuple[Statements, ...]
    lists: dict[str, list[float]]


def units_of(text: str) -> list[Unit]:
    """All of a source file, in its order."""
    text = re.sub(r"\(\*.*?\*\)", "", text, flags=re.S)
    found = re.compile(r"^(FUNCTION_BLOCK|FUNCTION|PROGRAM|TYPE)\b[^\n]*\n.*?^END_\1\b;?", re.S | re.M).finditer(text)
    ends, units = 0, []
    for unit in found:
        assert not text[ends : unit.start()].strip(), text[ends : unit.start()]
        ends = unit.end()
        units.append(_unit(unit[0]))
    assert not text[ends:].strip(), text[ends:]
    return units


def _unit(text: str) -> Unit:
    lists: dict[str, list[float]] = {}

    def shortened(found: re.Match[str]) -> str:
        texts = [t.strip() for t in found["list"].split(",")]
        assert all(LITERAL.fullmatch(t) for t in texts), found["name"]
        assert len(texts) == int(found["last"]) + 1, found["name"]
        lists[found["name"]] = [t == "TRUE" if t in ("TRUE", "FALSE") else _number(t) for t in texts]
        few = ", ".join(texts[:FEW])
        return f"{found['name']} : ARRAY[0..{len(texts[:FEW]) - 1}] OF {found['of']} := [{few}];"

    kind, name = re.match(r"(\w+)\s+(\w+)", text).groups()  # type: ignore[union-attr]
    if kind == "TYPE":
        return Unit(kind, name, parsed(text, "iec_source").items[0].declaration, (), {})
    lines = text.splitlines()
    last = max((k for k, line in enumerate(lines) if line == "END_VAR"), default=0)
    head = "\n".join([*lines[: last + 1], ";", lines[-1], ""])
    head = re.sub(
        r"(?P<name>\w+) : ARRAY\[0\.\.(?P<last>\d+)\] OF (?P<of>\w+) := \[(?P<list>[^\]]*)\];", shortened, head
    )
    statements = tuple(_statements(piece) for piece in _pieces(lines[last + 1 : -1]))
    return Unit(kind, name, parsed(head, "iec_source").items[0], statements, lists)


def stand_in(k: int, number: str) -> str:
    """The number that stands for the k-th of a statement: of the same type, and none that a text has."""
    return f"{FIRST + k}.5" if "." in number else str(FIRST + k)


def _statements(text: str) -> Statements:
    numbers: list[str] = []

    def taken(found: re.Match[str]) -> str:
        numbers.append(found[0])
        return stand_in(len(numbers) - 1, found[0])

    shape = re.sub(r"(?<![\w.])\d+(\.\d+(E[+-]\d\d+)?)?", taken, text)
    return Statements(tuple(parsed(shape, "statement_list").statements), tuple(numbers))


def _number(text: str) -> float:
    return int(text) if re.fullmatch(r"-?\d+", text) else float(text)


def _pieces(lines: list[str]) -> Iterator[str]:
    """Whole statements."""
    held: list[str] = []
    depth = 0
    for line in lines:
        held.append(line)
        word = line.strip()
        depth += bool(BEGINS.match(word)) - bool(ENDS.match(word))
        if depth == 0 and word.endswith(";"):
            yield "\n".join(held) + "\n"
            held = []
    assert not held, held


@cache
def parsed(text: str, start: str) -> Any:
    """blark's tree of a text."""
    try:
        found = get_parser().parse(text, start=start)
    except lark.exceptions.LarkError as error:
        raise AssertionError(f"blark does not read\n{text}\n{error}") from error
    return tree.GrammarTransformer([]).transform(found)
