"""Texts as they may be shown: in one line, and without characters that would act on whoever shows them."""

from __future__ import annotations

import re
from typing import Any

from loopwright.serving.errors import LoopwrightError

# Line breaks, control characters, marks and overrides of direction, the mark of a byte order: they forge a line, clear
# a screen or turn a text round wherever it is shown.
ACTS = re.compile("[\x00-\x1f\x7f-\x9f\u061c\u200e\u200f\u2028-\u202e\u2066-\u2069\ufeff]")


def plain(text: str) -> str:
    """A text of a file, a server or a person as it may be shown: control and direction characters are spelt out.

    It then clears no screen, turns no line round, and begins no line of its own.
    """
    if text.isprintable():
        return text
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in text)


def harmless(text: str) -> str:
    """A text of many lines as it may be shown: what would act on a reader is spelt out, but lines and tabs stay."""
    return ACTS.sub(lambda c: c[0] if c[0] in "\n\t" else c[0].encode("unicode_escape").decode(), text)


def plain_tree(value: Any) -> Any:
    """The same for all texts and keys in lists and objects."""
    if isinstance(value, str):
        return plain(value)
    if isinstance(value, dict):
        return {plain(str(key)): plain_tree(inner) for key, inner in value.items()}
    return [plain_tree(inner) for inner in value] if isinstance(value, list | tuple) else value


def first_line(error: Exception) -> str:
    """The first line of the error's text; its type if the text is empty."""
    name = type(error).__name__
    try:
        return plain((str(error).strip().splitlines() or [name])[0])
    except Exception:
        return name


def named(error: Exception) -> str:
    """The error in one line. One of our own is a sentence for a person; of any other the type is told too."""
    if isinstance(error, LoopwrightError):
        return first_line(error)
    name, text = type(error).__name__, first_line(error)
    return name if text == name else f"{name}: {text}"
