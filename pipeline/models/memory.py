"""Named tensors: the memory of a law, and an affine function of them as one matrix."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import torch
from torch import Tensor, nn

Named = Mapping[str, Tensor]
Formula = Callable[[Named], Tensor]
"""An affine function of named tensors (..., n): sums, differences, constants, factors that do not depend on them."""


@dataclass(frozen=True, slots=True)
class Slot:
    """One remembered vector: what it is without a past, and what it is next.

    ``start`` is numbers (size,), or a function of y, r and u of the first sample; ``then`` a function of
    those of any sample and of all that is remembered. Without ``then`` the law gives the next value itself.
    """

    size: int
    start: Formula | Tensor
    then: Formula | None = None


def lag_slots(n_y: int, n_u: int, *, measured: bool = True) -> dict[str, Slot]:
    """The lags y(t-1) .. y(t-n_y) and u(t-2) .. u(t-n_u), which ``regressors`` reads.

    Without a past the first measurement and the MV that is on stand for all of them. With
    ``measured`` y(t-1) is what was measured; otherwise the law gives what is remembered of y.
    """
    return {
        "y1": Slot(1, lambda p: p["y"], (lambda p: p["y"]) if measured else None),
        "ys": Slot(n_y - 1, lambda p: _repeated(p["y"], n_y - 1), lambda p: _first([p["y1"], p["ys"]], n_y - 1)),
        "us": Slot(n_u - 1, lambda p: _repeated(p["u"], n_u - 1), lambda p: _first([p["u"], p["us"]], n_u - 1)),
    }


def regressors(p: Named, n_y: int, n_u: int) -> tuple[Tensor, Tensor]:
    """The regressor phi(t) = [y(t-1), .., u(t-1), ..] and phi(t+1) with u(t) = u(t-1), both (..., n_y + n_u)."""
    now = torch.cat([p["y1"], p["ys"], p["u"], p["us"]], dim=-1)
    ahead = torch.cat([_first([p["y"], p["y1"], p["ys"]], n_y), _first([p["u"], p["u"], p["us"]], n_u)], dim=-1)
    return now, ahead


def _repeated(value: Tensor, n: int) -> Tensor:
    return value.expand(*value.shape[:-1], n)


def _first(parts: list[Tensor], n: int) -> Tensor:
    return torch.cat(parts, dim=-1)[..., :n]


class Memory(nn.Module):
    """The state of a law as named slots, in which zero means "no past".

    The state is [started, slots with ``then``, slots without]; ``layout`` has their sizes.
    """

    def __init__(self, slots: Mapping[str, Slot]) -> None:
        super().__init__()
        self.known = {name: slot for name, slot in slots.items() if slot.then is not None}
        self.given = {name: slot for name, slot in slots.items() if slot.then is None}
        sizes = {name: slot.size for name, slot in (self.known | self.given).items()}
        self.n_state = 1 + sum(sizes.values())
        self.layout = {"started": 1, **sizes}
        for name, slot in slots.items():
            if isinstance(slot.start, Tensor):
                self.register_buffer(f"first_{name}", slot.start)

    def recall(self, sp: Tensor, pv: Tensor, mv_applied: Tensor, state: Tensor) -> dict[str, Tensor]:
        """The past and the sample by name, (..., size) each; where there is no past, a still one.

        ``started`` is 0 at the first sample, y the first PV, r the set point, u the applied MV.
        """
        sample = {"y": pv[..., :1], "r": sp, "u": mv_applied}
        started = state[..., :1]
        first = [self._first(slot, name, sample) for name, slot in (self.known | self.given).items()]
        # Without a past the whole state is zero, so that the first values need only be added.
        state = state + (1 - started) * torch.cat([torch.zeros_like(started), *first], dim=-1)
        past = torch.split(state, list(self.layout.values()), dim=-1)
        return {**dict(zip(self.layout, past, strict=True)), **sample, "started": started}

    def stored(self, p: Named, given: Named) -> Tensor:
        """The next state (..., n_state), from the past and the slots that the law computes."""
        one = torch.ones_like(p["y"])
        known = [slot.then(p) for slot in self.known.values() if slot.then is not None]
        return torch.cat([one, *known, *(given[name] for name in self.given)], dim=-1)

    def _first(self, slot: Slot, name: str, sample: Named) -> Tensor:
        """A slot without a past."""
        if not isinstance(slot.start, Tensor):
            return slot.start(sample)
        numbers: Tensor = getattr(self, f"first_{name}")
        return numbers.expand(*sample["y"].shape[:-1], slot.size)


class AffineMap(nn.Module):
    """Named affine functions of a named vector, ``x (..., n) -> {name: (..., k)}``: one product, one sum, one split.

    ``formulas`` maps the pieces of x to the results; it is asked once, for every unit vector and
    for zero, so that it may be written as the formulas stand.
    """

    matrix: Tensor  # (n, sum of k)
    offset: Tensor  # (sum of k,)

    @torch.no_grad()
    def __init__(self, layout: Mapping[str, int], formulas: Callable[[Named], Named]) -> None:
        super().__init__()
        n = sum(layout.values())
        points = torch.cat([torch.eye(n, dtype=torch.float64), torch.zeros(1, n, dtype=torch.float64)])
        results = formulas(dict(zip(layout, torch.split(points, list(layout.values()), dim=-1), strict=True)))
        self.sizes = {name: value.shape[-1] for name, value in results.items()}
        table = torch.cat(list(results.values()), dim=-1)
        self.register_buffer("matrix", (table[:-1] - table[-1]).contiguous())
        self.register_buffer("offset", table[-1].clone())

    def forward(self, x: Tensor, offset: Tensor | None = None) -> dict[str, Tensor]:
        """The results at x (..., n); ``offset`` (..., sum of k) in place of the map's own."""
        constant = self.offset if offset is None else offset
        parts = torch.split(x @ self.matrix + constant, list(self.sizes.values()), dim=-1)
        return dict(zip(self.sizes, parts, strict=True))
