"""The tree of errors, from the classes."""

from __future__ import annotations

import importlib
import inspect
import re
from collections.abc import Iterator
from pathlib import Path

from loopwright.pipeline.stages.code import PACKAGES
from loopwright.serving.errors import LoopwrightError
from manual.markdown import code, prose, table

DEFINED = re.compile(r"^class \w+Error\(", re.MULTILINE)


def load_all() -> None:
    """Import every module that defines an error: what is imported already depends on who asks."""
    for package in PACKAGES:
        root = Path(importlib.import_module(package).__path__[0])
        for file in sorted(root.rglob("*.py")):
            if DEFINED.search(file.read_text(encoding="utf-8")):
                parts = file.relative_to(root).with_suffix("").parts
                importlib.import_module(".".join((package, *parts)).removesuffix(".__init__"))


def known() -> list[type[LoopwrightError]]:
    """Every error class of the packages, a class before those below it, in the order of modules and lines."""
    load_all()
    return list(dict.fromkeys(_below(LoopwrightError)))


def _below(cls: type[LoopwrightError]) -> Iterator[type[LoopwrightError]]:
    yield cls
    for sub in sorted(cls.__subclasses__(), key=lambda sub: (sub.__module__, inspect.getsourcelines(sub)[1])):
        if sub.__module__.startswith(("loopwright.serving", "loopwright.pipeline")):
            yield from _below(sub)


def errors() -> str:
    """The tree as text, then a row for each class."""
    lines = [f"{'    ' * (len(_line(cls)) - 1)}{cls.__name__}" for cls in known()]
    rows = [(code(cls.__name__), code(cls.__module__), prose(cls.__doc__)) for cls in known()]
    return "\n\n".join(["```text\n" + "\n".join(lines) + "\n```", table(["error", "module", "raised where"], rows)])


def _line(cls: type[Exception]) -> list[type]:
    return [c for c in cls.__mro__ if issubclass(c, LoopwrightError)]
