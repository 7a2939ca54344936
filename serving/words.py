"""Errors in one line, for a command's reason and for a log."""

from __future__ import annotations

from serving.errors import LoopwrightError


def first_line(error: Exception) -> str:
    """The first line of the error's text; its type if the text is empty."""
    name = type(error).__name__
    try:
        return (str(error).strip().splitlines() or [name])[0]
    except Exception:
        return name


def named(error: Exception) -> str:
    """The error in one line. One of our own is a sentence for a person; of any other the type is told too."""
    if isinstance(error, LoopwrightError):
        return first_line(error)
    name, text = type(error).__name__, first_line(error)
    return name if text == name else f"{name}: {text}"
