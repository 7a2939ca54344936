"""The memory of a law, by name; and everything that is affine in it, computed as one matrix product."""

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
    """One remembered vector: what it is without a past, and (where that is affine) what it is next.

    ``start`` is affine in y, r and u of the first sample; ``then`` in those of any sample and in all
    that is remembered. Without ``then`` the law gives the next value itself.
    """

    size: int
    start: Formula
    then: Formula | None = None


def constant(values: Tensor) -> Formula:
    """The formula of numbers that depend on nothing, values (n,)."""
    return lambda p: values.expand(*p["y"].shape[:-1], len(values))


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


class Stage(nn.Module):
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

    def forward(self, x: Tensor) -> dict[str, Tensor]:
        """The results at x (..., n)."""
        parts = torch.split(x @ self.matrix + self.offset, list(self.sizes.values()), dim=-1)
        return dict(zip(self.sizes, parts, strict=True))


class Memory(nn.Module):
    """The state of a law as named slots, in which zero means "no past".

    The state is [started, slots with ``then``, slots without]; ``layout`` names its pieces and, after
    them, those of the sample: y, r, u.
    """

    def __init__(self, slots: Mapping[str, Slot]) -> None:
        super().__init__()
        self.affine = {name: slot for name, slot in slots.items() if slot.then is not None}
        self.given = {name: slot for name, slot in slots.items() if slot.then is None}
        sizes = {name: slot.size for name, slot in (self.affine | self.given).items()}
        self.n_state = 1 + sum(sizes.values())
        self.layout = {"started": 1, **sizes, "y": 1, "r": 1, "u": 1}
        self.fresh = Stage(self.layout, self._fresh)

    def _fresh(self, p: Named) -> Named:
        slots = self.affine | self.given
        same = {name: p[name] for name in ("started", "y", "r", "u")}
        found = {**same, **{name: slot.start(p) for name, slot in slots.items()}}
        return {"all": torch.cat([found[name] for name in self.layout], dim=-1)}

    def recall(self, sp: Tensor, pv: Tensor, mv_applied: Tensor, state: Tensor) -> Tensor:
        """The past and the sample as one vector of ``layout``, shape (..., n); where there is no past, a still one.

        ``started`` in it stays 0 at the first sample.
        """
        x = torch.cat([state, pv[..., :1], sp, mv_applied], dim=-1)
        return torch.where(state[..., :1] > 0, x, self.fresh(x)["all"])

    def then(self, p: Named) -> Tensor:
        """The formula of the state's first part, which ``stored`` takes as ``known``."""
        one = torch.ones_like(p["y"])
        return torch.cat([one, *(slot.then(p) for slot in self.affine.values() if slot.then is not None)], dim=-1)

    def stored(self, known: Tensor, given: Named) -> Tensor:
        """The next state from ``then`` and the slots that the law computes."""
        return torch.cat([known, *(given[name] for name in self.given)], dim=-1)
