"""A frozen dataclass of parameters as a table for a person: name, type, default, and what its docstring says."""

from __future__ import annotations

import dataclasses
import inspect
import re
import textwrap
import typing
from typing import Any

WIDTH = 110


def show(params: type[Any]) -> None:
    """Print every parameter with its type and default, then the words of the docstrings."""
    rows = [(f.name, str(f.type), default_of(f)) for f in dataclasses.fields(params) if f.init]
    if not rows:
        print("no parameters")
        return
    columns = [max(len(row[i]) for row in (*rows, ("parameter", "type", "default"))) for i in range(2)]
    for row in (("parameter", "type", "default"), *rows):
        print(f"{row[0]:{columns[0]}}  {row[1]:{columns[1]}}  {row[2]}")
    for text in texts(params):
        print()
        for block in re.split(r"\n\s*\n", text):
            words = " ".join(block.replace("``", "").split())
            print("\n".join(textwrap.wrap(words, WIDTH)) if not block.startswith("    ") else block)
    hints = typing.get_type_hints(params)
    for f in dataclasses.fields(params):
        if dataclasses.is_dataclass(hints[f.name]):
            print(f"\n{f.name}:\n")
            show(hints[f.name])


def texts(params: type[Any]) -> list[str]:
    """The docstrings that describe the parameters, those of the class itself first."""
    found = []
    for cls in params.__mro__:
        own = cls.__dict__.get("__doc__")
        if cls is not object and dataclasses.is_dataclass(cls) and own and not own.startswith(f"{cls.__name__}("):
            found.append(inspect.cleandoc(own))
    return found


def first_sentence(cls: type[Any]) -> str:
    """What the class is, in its own words."""
    return " ".join((inspect.getdoc(cls) or "").split("\n\n")[0].replace("``", "").split())


def default_of(field: dataclasses.Field[Any]) -> str:
    """The default of a parameter; ``required`` where it has none."""
    if field.default is not dataclasses.MISSING:
        return str(field.default)
    if field.default_factory is not dataclasses.MISSING:
        return str(field.default_factory())
    return "required"
