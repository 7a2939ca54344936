"""The tree of errors, from the classes."""

from __future__ import annotations

from collections.abc import Iterator

from loopwright.pipeline.evaluation.evidence import NotMeasuredError
from loopwright.pipeline.historian.cleaning.tags import TableError
from loopwright.serving.errors import LoopwrightError
from manual.markdown import code, prose, table

ELSEWHERE = (NotMeasuredError, TableError)
"""Errors that stand beside the one module that raises them; their import makes them known."""


def known() -> list[type[LoopwrightError]]:
    """Every error class of the packages, a class before those below it."""
    return list(dict.fromkeys(_below(LoopwrightError)))


def _below(cls: type[LoopwrightError]) -> Iterator[type[LoopwrightError]]:
    yield cls
    for sub in cls.__subclasses__():
        if sub.__module__.startswith(("loopwright.serving", "loopwright.pipeline")):
            yield from _below(sub)


def errors() -> str:
    """The tree as text, then a row for each class."""
    lines = [f"{'    ' * (len(_line(cls)) - 1)}{cls.__name__}" for cls in known()]
    rows = [(code(cls.__name__), code(cls.__module__), prose(cls.__doc__)) for cls in known()]
    return "\n\n".join(["```text\n" + "\n".join(lines) + "\n```", table(["error", "module", "raised where"], rows)])


def _line(cls: type[Exception]) -> list[type]:
    return [c for c in cls.__mro__ if issubclass(c, LoopwrightError)]
