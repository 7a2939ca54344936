"""Numbers as text that every language reads back to the same bits: C's hexadecimal floats."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from loopwright.serving.errors import ContractError

Array: TypeAlias = NDArray[np.float64]


def written(values: Iterable[float]) -> list[str]:
    """Each value as ``float.hex`` writes it: 0x1.8000000000000p+1, nan, inf, -inf."""
    return [float(value).hex() for value in values]


def read(texts: object, where: str) -> Array:
    """The values (n,) that ``written`` wrote; ContractError names ``where`` if one is no such number."""
    if not isinstance(texts, list):
        raise ContractError(f"{where} is {str(texts)[:60]!r}; it must be a list of hexadecimal floats as text")
    try:
        return np.array([float.fromhex(text) for text in texts], dtype=np.float64)
    except (TypeError, ValueError, OverflowError) as error:
        raise ContractError(f"{where} holds no hexadecimal float: {error}") from error


def read_all(row: Mapping[str, Any], where: str) -> dict[str, Array]:
    """Each entry of ``row`` by ``read``."""
    return {name: read(texts, f"{where}.{name}") for name, texts in row.items()}
