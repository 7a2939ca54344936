"""Tensors of a graph as entries of arrays: what only looks at a tensor in another way costs nothing."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from math import prod

from loopwright.pipeline.export.plain_code.statements import Place


@dataclass(frozen=True, slots=True)
class View:
    """A tensor as entries of an array; ``strides`` in entries, 0 where it repeats."""

    buffer: str
    shape: tuple[int, ...]
    strides: tuple[int, ...]
    offset: int = 0

    @classmethod
    def whole(cls, buffer: str, shape: Sequence[int]) -> View:
        """All of an array, the last dimension fastest."""
        strides = [prod(shape[d + 1 :]) for d in range(len(shape))]
        return cls(buffer, tuple(shape), tuple(strides))

    @property
    def dense(self) -> bool:
        """Whether its entries follow each other."""
        wanted = View.whole(self.buffer, self.shape).strides
        return all(n == 1 or s == w for n, s, w in zip(self.shape, self.strides, wanted, strict=True))

    def broadcast(self, shape: Sequence[int]) -> View:
        """Repeated to a larger shape, as ONNX repeats."""
        more = len(shape) - len(self.shape)
        held, strides = (1,) * more + self.shape, (0,) * more + self.strides
        found = tuple(0 if n == 1 else s for n, s in zip(held, strides, strict=True))
        return replace(self, shape=tuple(shape), strides=found)

    def part(self, axis: int, start: int, count: int, step: int = 1) -> View:
        """``count`` entries of an axis, from ``start`` by ``step``."""
        shape, strides = list(self.shape), list(self.strides)
        shape[axis], strides[axis] = count, strides[axis] * step
        return View(self.buffer, tuple(shape), tuple(strides), self.offset + start * self.strides[axis])

    def place(self) -> Place:
        """Where it is read or written in a nest of loops over its shape."""
        return Place(self.buffer, self.offset, self.strides)

    def turned(self) -> View:
        """Its dimensions in reverse order."""
        return replace(self, shape=self.shape[::-1], strides=self.strides[::-1])

    def without(self, axes: Sequence[int]) -> View:
        """Without these dimensions, of one entry each."""
        gone = {a % len(self.shape) for a in axes}
        kept = [d for d in range(len(self.shape)) if d not in gone]
        return replace(self, shape=tuple(self.shape[d] for d in kept), strides=tuple(self.strides[d] for d in kept))
