"""Settings that a person wrote, as frozen dataclasses; every mistake in them is one clear error."""

from __future__ import annotations

import dataclasses
import difflib
import functools
import math
import types
import typing
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, TypeVar

from loopwright.serving.errors import LoopwrightError

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


# -------------------------------------------------------------------------------------- settings as frozen dataclasses
T = TypeVar("T")


def is_number(value: object) -> bool:
    """Whether a value of JSON or of a host is a finite number."""
    if isinstance(value, bool) or not isinstance(value, int | float):
        return False
    try:
        return math.isfinite(value)
    except OverflowError:  # an integer of some hundred digits
        return False


MOST_KNOWN = 24  # names in a message, as of all laws: a longer list hides the one that is meant


def nearest(word: object, known: Iterable[str]) -> str:
    """The end of an error message: the nearest known word, and all of them, or the nearest of many."""
    names, asked = sorted(str(k) for k in known), word if isinstance(word, str) else shown(word)
    close = difflib.get_close_matches(asked, names, n=1)
    hint = f"; did you mean {close[0]!r}?" if close else ";"
    if len(names) <= MOST_KNOWN:
        return f"{hint} known: {', '.join(names) or 'none'}"
    few = sorted(difflib.get_close_matches(asked, names, n=MOST_KNOWN // 2, cutoff=0.0))
    return f"{hint} the nearest of {len(names)}: {', '.join(few)}"


def parse(cls: type[T], values: Any, where: str, error: type[Exception]) -> T:
    """``values`` as the dataclass ``cls``, types checked, nested dataclasses too.

    Raises ``error`` that names ``where`` for an unknown or missing key, a wrong type, and what the
    dataclass's own checks refuse.
    """
    if not isinstance(values, Mapping):
        raise error(f"{where} is {values!r}; it must be a mapping")
    hints = _hints(cls)  # type: ignore[arg-type]
    fields = {f.name: f for f in dataclasses.fields(cls) if f.init}  # type: ignore[arg-type]
    for key in values:
        if key not in fields:
            raise error(f"{where}: unknown key {shown(key)}{nearest(key, fields)}")
    for name, field in fields.items():
        required = field.default is dataclasses.MISSING and field.default_factory is dataclasses.MISSING
        if required and name not in values:
            raise error(f"{where}: {name!r} is missing")
    read = {key: _convert(hints[key], value, f"{where}.{key}", error) for key, value in values.items()}
    try:
        return cls(**read)
    except (ValueError, TypeError, LoopwrightError) as refused:
        raise error(f"{where}: {refused}") from None


@functools.cache
def _hints(cls: type) -> Mapping[str, Any]:
    """The types of a dataclass's fields; read once, because each annotation is compiled for it."""
    return typing.get_type_hints(cls)


def _convert(hint: Any, value: Any, where: str, error: type[Exception]) -> Any:
    origin, args = typing.get_origin(hint), typing.get_args(hint)
    if origin in (typing.Union, types.UnionType):
        if value is None and type(None) in args:
            return None
        rest = [a for a in args if a is not type(None)]
        for option in rest[:-1]:
            try:
                return _convert(option, value, where, error)
            except error:
                continue
        return _convert(rest[-1], value, where, error)
    if origin is typing.Literal:
        if value not in args:
            raise error(f"{where} is {shown(value)}{nearest(value, map(str, args))}")
        return value
    if origin is tuple:
        if not isinstance(value, (list, tuple)):
            raise error(f"{where} is {shown(value)}; it must be a list")
        inner = [args[0]] * len(value) if args[-1] is Ellipsis else list(args)
        if len(inner) != len(value):
            raise error(f"{where} has {len(value)} entries; it must have {len(inner)}")
        return tuple(_convert(h, v, f"{where}[{i}]", error) for i, (h, v) in enumerate(zip(inner, value, strict=True)))
    if origin in (dict, Mapping) or (isinstance(origin, type) and issubclass(origin, Mapping)):
        if not isinstance(value, Mapping):
            raise error(f"{where} is {shown(value)}; it must be a mapping")
        return {str(k): _convert(args[1], v, f"{where}.{k}", error) for k, v in value.items()}
    if dataclasses.is_dataclass(hint):
        return parse(hint, value, where, error)  # type: ignore[arg-type]
    return _plain(hint, value, where, error)


def _plain(hint: Any, value: Any, where: str, error: type[Exception]) -> Any:
    if hint is Any:
        return value
    if hint is float and isinstance(value, (int, float, str)) and not isinstance(value, bool):
        try:
            number = float(value)  # YAML 1.1 reads 5e-4 (no dot) as text
        except (ValueError, OverflowError):
            raise error(f"{where} is {shown(value)}; it must be a number") from None
        if not math.isfinite(number):
            raise error(f"{where} is {shown(value)}; it must be a finite number")
        return number
    if hint is Path and isinstance(value, str):
        return Path(value)
    if (isinstance(value, bool) and hint is not bool) or not isinstance(value, hint):
        raise error(f"{where} is {shown(value)}; it must be of type {hint.__name__}")
    return value
