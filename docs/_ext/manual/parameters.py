"""Frozen dataclasses of parameters as tables: name, type, unit, default, words."""

from __future__ import annotations

import dataclasses
import inspect
import re
import sys
import tomllib
import types
import typing
from collections.abc import Iterator, Mapping
from functools import cache
from pathlib import Path
from typing import Any

from loopwright.pipeline.commands.parameters import default_of, texts
from manual.markdown import code, prose, table

WORDS = Path(__file__).with_name("words.toml")
"""Words for what no docstring describes: class -> field -> words."""
UNITS = {"_s": "s", "_mb": "MB", "_per_min": "unit/min"}
UNIT = re.compile(r"(``\w+``(?:,? (?:and )?``\w+``)*)(?: \([^)]*\))?:?[^`.;\[\]]{0,12}?\s\[([^\], ]+(?: [^\], ]+)?)\]")


@cache
def words() -> Mapping[str, Mapping[str, str]]:
    """``WORDS``, read once."""
    return tomllib.loads(WORDS.read_text(encoding="utf-8"))


@cache
def described(cls: type[Any]) -> list[str]:
    """The docstrings that describe the fields: the class's own, its bases', and those that it names as ``XParams``."""
    own = texts(cls)
    scope = vars(sys.modules[cls.__module__])
    named = [scope.get(name) for text in own for name in re.findall(r"\b[A-Z]\w*Params\b", text)]
    others = [t for other in named if dataclasses.is_dataclass(other) and other is not cls for t in described(other)]
    return list(dict.fromkeys(own + others))


@cache
def meanings(cls: type[Any]) -> Mapping[str, tuple[str, str]]:
    """Field -> unit and words: of numpydoc's lists, of comments behind the fields, of ``WORDS``; the last ones win."""
    found: dict[str, tuple[str, str]] = {}
    for text in described(cls):
        for block in re.findall(
            r"^(?:Parameters|Attributes)\n-+\n((?:\S.*\n(?:    .*(?:\n|$))+)+)", text, re.MULTILINE
        ):
            for names, about in re.findall(r"^(\S.*)\n((?:    .*(?:\n|$))+)", block, re.MULTILINE):
                said = prose(" ".join(about.split()))
                for group, unit in re.findall(r"(\w+(?:, \w+)*)(?: \[([^\]]+)\])?", names):
                    found.update(dict.fromkeys(group.split(", "), (unit, said)))
    for base in reversed(cls.__mro__):
        if dataclasses.is_dataclass(base):
            source = inspect.getsource(base)
            comments = re.findall(r"^    (\w+): .*?  # (?!type:|fmt:)(.+)$", source, re.MULTILINE)
            found.update({name: ("", prose(about)) for name, about in comments})
        found.update({name: ("", text) for name, text in words().get(base.__qualname__, {}).items()})
    return found


def fields(cls: type[Any]) -> list[dataclasses.Field[Any]]:
    """The fields that a person gives."""
    return [f for f in dataclasses.fields(cls) if f.init]


def is_described(cls: type[Any], name: str) -> bool:
    """Whether a docstring, a comment or ``WORDS`` says what the field is."""
    return name in meanings(cls) or any(f"``{name}``" in text for text in described(cls))


def unit_of(cls: type[Any], field: dataclasses.Field[Any]) -> str:
    """The unit as the words or the name state it; empty for a plain number and for text."""
    unit, text = meanings(cls).get(field.name, ("", ""))
    if unit:
        return "" if unit == "-" else unit
    if stated := re.search(r"\\?\[([^\], ]+(?: [^\], ]+)?)\\?\]", text):
        return stated[1].rstrip("\\")
    for names, stated_unit in UNIT.findall(" ".join(" ".join(described(cls)).split())):
        if f"`{field.name}`" in names:
            return str(stated_unit)
    return next((unit for end, unit in UNITS.items() if field.name.endswith(end)), "")


def type_of(cls: type[Any], field: dataclasses.Field[Any]) -> str:
    """The type as a person reads it, a name of one written out."""
    text = field.type if isinstance(field.type, str) else getattr(field.type, "__name__", str(field.type))
    hint = typing.get_type_hints(cls)[field.name]
    if text.isidentifier() and not isinstance(hint, type):
        text = str(hint)
    text = re.sub(r"\b(?:\w+\.)+(?=\w)", "", text)
    return re.sub(r"Literal\[(.*?)\]", lambda m: re.sub("[\"']", "", m[1]).replace(", ", " or "), text)


def parameters(cls: type[Any]) -> str:
    """The table of one class, and the words of its docstrings."""
    rows = [
        (
            code(f.name),
            code(type_of(cls, f)),
            unit_of(cls, f),
            code(_default(f)),
            meanings(cls).get(f.name, ("", ""))[1],
        )
        for f in fields(cls)
    ]
    if not rows:
        return "No parameters."
    head = ["parameter", "type", "unit", "default", "meaning"]
    if not any(row[4] for row in rows):
        head, rows = head[:4], [row[:4] for row in rows]
    return "\n\n".join([table(head, rows), *(prose(_listed(_without_lists(text), cls)) for text in described(cls))])


def _without_lists(text: str) -> str:
    """The docstring without the lists whose entries stand in the table."""
    return re.sub(r"^(?:Parameters|Attributes)\n-+\n(?:.+(?:\n|$))+", "", text, flags=re.MULTILINE).strip()


def _listed(text: str, cls: type[Any]) -> str:
    """The docstring with a paragraph for each field that a sentence or a clause begins with."""
    names = "|".join(f.name for f in fields(cls))
    begins = re.compile(rf"(?:^|(?<=[.;]) )(?=``(?:{names})``)")
    blocks = re.split(r"\n\s*\n", text)
    return "\n\n".join(b if b.startswith("    ") else begins.sub("\n\n- ", " ".join(b.split())) for b in blocks)


def _default(field: dataclasses.Field[Any]) -> str:
    for value in (field.default, field.default_factory):
        if dataclasses.is_dataclass(value):  # its own defaults stand in its own table
            return f"{(value if isinstance(value, type) else type(value)).__name__}()"
    return default_of(field) or '""'


def parts_of(cls: type[Any]) -> Iterator[tuple[str, type[Any]]]:
    """(key, class) of each dataclass within the fields, its own parts after it."""
    hints = typing.get_type_hints(cls)
    for f in fields(cls):
        for part in _dataclasses(hints[f.name]):
            yield f.name, part
            yield from ((f"{f.name}.{key}", inner) for key, inner in parts_of(part))


def _dataclasses(hint: Any) -> Iterator[type[Any]]:
    if isinstance(hint, type) and dataclasses.is_dataclass(hint):
        yield hint
    elif isinstance(hint, types.UnionType) or typing.get_origin(hint) is not None:
        for inner in typing.get_args(hint):
            yield from _dataclasses(inner)


def whole(cls: type[Any], *, depth: int = 3) -> str:
    """The table of a class, then of each class within it under a heading of its own; each once."""
    done, seen = [parameters(cls)], {cls}
    for key, part in parts_of(cls):
        if part not in seen:
            seen.add(part)
            done.append(f"{'#' * depth} `{key}`\n\n{parameters(part)}")
    return "\n\n".join(done)
