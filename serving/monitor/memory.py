"""What a detector has learnt, as JSON-ready values and back: a loop that starts again need not learn anew."""

from __future__ import annotations

from typing import Any

import numpy as np


class Remembers:
    """Keeps the attributes in ``KEPT``: numbers, texts, lists, arrays, and others that remember, or lists of them."""

    KEPT: tuple[str, ...] = ()

    def memory(self) -> dict[str, Any]:
        """The attributes, JSON-ready."""
        return {name: _out(getattr(self, name)) for name in self.KEPT}

    def recall(self, memory: dict[str, Any]) -> None:
        """Take them back. ValueError, KeyError or TypeError where they are of another kind or shape."""
        for name in self.KEPT:
            setattr(self, name, _in(getattr(self, name), memory[name]))


def _out(value: Any) -> Any:
    if isinstance(value, Remembers):
        return value.memory()
    if isinstance(value, list):
        return [_out(v) for v in value]
    return value.tolist() if isinstance(value, np.ndarray) else value


def _in(present: Any, kept: Any) -> Any:
    if isinstance(present, Remembers):
        present.recall(kept)
        return present
    if isinstance(present, list) and present and isinstance(present[0], Remembers):
        if len(kept) != len(present):
            raise ValueError(f"{len(kept)} detectors instead of {len(present)}")
        return [_in(p, k) for p, k in zip(present, kept, strict=True)]
    if isinstance(present, np.ndarray):
        array = np.array(kept, dtype=np.float64)
        if array.shape != present.shape or not np.isfinite(array).all():
            raise ValueError(f"an array of the shape {array.shape} instead of {present.shape}")
        return array
    if isinstance(present, bool | str) != isinstance(kept, bool | str) or isinstance(present, list) != isinstance(
        kept, list
    ):
        raise TypeError(f"{kept!r} in place of {present!r}")
    return kept
