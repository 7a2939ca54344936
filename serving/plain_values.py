"""Plain values of a text that somebody wrote: how deep and how long they may be, and how one stands in a message."""

from __future__ import annotations

from typing import Any

MAX_DIGITS = 300  # of an integer: float64 has none that is longer, and printing one of thousands fails
LONGEST_SHOWN = 100  # characters of a value in a message


def refused(tree: Any, depth: int) -> str:
    """Why a tree of dicts and lists is not taken: nested more than ``depth`` deep, or with too long an integer.

    Empty: it is taken.
    """
    level, at = [tree], 0
    while level:
        if at > depth:
            return f"lists or objects nested more than {depth} deep"
        if any(isinstance(value, int) and _bits(value) > _bits(10**MAX_DIGITS) for value in level):
            return f"an integer of more than {MAX_DIGITS} digits"
        level = [
            inner
            for outer in level
            if isinstance(outer, dict | list)
            for inner in (outer.values() if isinstance(outer, dict) else outer)
        ]
        at += 1
    return ""


def shown(value: object, most: int = LONGEST_SHOWN) -> str:
    """A value in a message, in one line of at most ``most`` characters and an ellipsis."""
    try:
        text = repr(value)
    except ValueError:  # Python prints no integer of thousands of digits
        return "an integer of thousands of digits" if isinstance(value, int) else "a list with such an integer"
    except RecursionError:
        return "lists that are nested too deep"
    return text if len(text) <= most else f"{text[:most]}..."


def _bits(value: int) -> int:
    return value.bit_length()
