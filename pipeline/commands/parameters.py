"""A frozen dataclass of parameters as a table for a person: name, type, default, and what its docstring says."""

from __future__ import annotations

import dataclasses
import inspect
import re
import textwrap
import types
import typing
from collections.abc import Mapping
from typing import Any

from loopwright.pipeline.config.params import choose

PARAMETERS_WIDTH = 110  # letters of a line


def list_or_show(table: Mapping[str, tuple[str, type[Any]]], name: str | None, what: str) -> None:
    """Print each entry of the table, name -> (title, parameters), in a line; or the one that is named, in full."""
    if name is None:
        for entry, (title, _) in table.items():
            print(f"{entry:28} {title}")
        return
    title, params = choose(table, name, what)
    print(f"{name}: {title}\n")
    show(params)


def show(params: type[Any]) -> None:
    """Print every parameter with its type and default, then the words of the docstrings."""
    rows = [(f.name, type_of(f), default_of(f)) for f in dataclasses.fields(params) if f.init]
    if not rows:
        print("no parameters")
        return
    rows.insert(0, ("parameter", "type", "default"))
    columns = [max(len(row[i]) for row in rows) for i in range(2)]
    for row in rows:
        print(f"{row[0]:{columns[0]}}  {row[1]:{columns[1]}}  {row[2]}")
    for text in texts(params):
        print()
        for block in re.split(r"\n\s*\n", text):
            words = " ".join(block.replace("``", "").split())
            print("\n".join(textwrap.wrap(words, PARAMETERS_WIDTH)) if not block.startswith("    ") else block)
    hints = typing.get_type_hints(params)
    for f in dataclasses.fields(params):
        if dataclasses.is_dataclass(hints[f.name]):
            print(f"\n{f.name}:\n")
            show(hints[f.name])


def texts(params: type[Any]) -> list[str]:
    """The docstrings that describe the parameters, those of the class itself first."""
    own = {cls: cls.__dict__.get("__doc__") or "" for cls in params.__mro__ if dataclasses.is_dataclass(cls)}
    # A dataclass without words of its own has its signature there.
    return [inspect.cleandoc(text) for cls, text in own.items() if text and not text.startswith(f"{cls.__name__}(")]


def first_sentence(cls: type[Any]) -> str:
    """First paragraph of the class's docstring."""
    return " ".join((inspect.getdoc(cls) or "").split("\n\n")[0].replace("``", "").split())


def type_of(field: dataclasses.Field[Any]) -> str:
    """The type of a parameter as its class writes it, whether its module puts off reading annotations or not."""
    if isinstance(field.type, type) and not isinstance(field.type, types.GenericAlias):
        return field.type.__name__
    return str(field.type)


def default_of(field: dataclasses.Field[Any]) -> str:
    """The default of a parameter; ``required`` where it has none."""
    if field.default is not dataclasses.MISSING:
        return str(field.default)
    if field.default_factory is not dataclasses.MISSING:
        return str(field.default_factory())
    return "required"
