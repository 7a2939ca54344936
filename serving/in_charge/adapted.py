"""A controller in a loop that reads more signals than it does: whether it fits there, and what it is given."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray

from loopwright.serving.controller import Controller, Step
from loopwright.serving.errors import ContractError, LoopError
from loopwright.serving.manifest import INPUTS, Manifest, Signal

Array: TypeAlias = NDArray[np.float64]


class AdaptedController(Controller):
    """A controller that gets its own PVs and measured disturbances out of a loop's, by name.

    Its ``manifest`` has all signals of the loop, so that whoever reads, judges, shows or writes down a scan does so as
    before; those that the controller reads have the ranges for which it was proven, and the MVs those of the actuator.
    ``inner`` is the controller itself, whose MVs may have narrower ones: from where an MV stands outside of them it
    goes there by its largest move a period.
    """

    def __init__(self, inner: Controller, loop: Manifest) -> None:
        own = inner.manifest
        self.inner, self.manifest = inner, _seen_as(own, loop)
        self.path, self.sha256, self.law_sha256 = inner.path, inner.sha256, inner.law_sha256
        self.size_bytes, self.summary = inner.size_bytes, inner.summary
        self._pv, self._dv = _places(own.pv, loop.pv), _places(own.dv, loop.dv)

    def step(
        self,
        *,
        sp: ArrayLike,
        pv: ArrayLike,
        mv_applied: ArrayLike,
        state: ArrayLike,
        dv: ArrayLike | None = None,
        operate: ArrayLike | None = None,
        fresh: ArrayLike | None = None,
        ahead: ArrayLike | None = None,
    ) -> Step:
        """One step, on all PVs and measured disturbances of the loop."""
        step = self.inner.step(
            sp=sp,
            pv=_picked(pv, self._pv, self.manifest.pv, "pv"),
            mv_applied=mv_applied,
            state=state,
            dv=_picked(dv, self._dv, self.manifest.dv, "dv") if "dv" in self.inner.manifest.inputs else None,
            operate=operate,
            fresh=None if fresh is None else _picked(fresh, self._pv, self.manifest.pv, "fresh"),
            ahead=None if ahead is None or self.manifest.ahead is None else self._known_ahead(ahead),
        )
        applied = np.asarray(mv_applied, dtype=np.float64).reshape(step.mv.shape)
        mv = [
            s.toward(min(max(float(at), s.low), s.high), float(wanted))
            for s, at, wanted in zip(self.manifest.mv, applied, step.mv, strict=True)
        ]
        return step._replace(mv=np.array(mv))

    def _known_ahead(self, ahead: ArrayLike) -> Array:
        """The numbers of ``ahead`` of the controller's own set points and measured disturbances."""
        n_sp, loops = len(self.manifest.sp), len(self.manifest.sp) + len(self.manifest.dv)
        own = [*range(n_sp), *(n_sp + place for place in self._dv)]
        return np.asarray(ahead, dtype=np.float64).reshape(-1, loops)[:, own].ravel()

    def warm(self) -> None:
        """Compute a first step, as ``Controller.warm`` does."""
        self.inner.warm()


def adapted(controller: Controller, loop: Manifest) -> Controller:
    """``controller`` for a loop that reads the signals of ``loop``: itself where it reads all of them.

    LoopError where it cannot take over there: another period, a signal that the loop does not read, another order of
    what it controls, other set points or MVs. The MVs' values must be the same, and their ranges within the loop's:
    these belong to the actuator. The ranges of set points and PVs say where a controller was proven, and may be others.
    """
    require_fits(controller.manifest, loop)
    return (
        controller
        if _seen_as(controller.manifest, loop) == controller.manifest
        else AdaptedController(controller, loop)
    )


def require_fits(own: Manifest, loop: Manifest) -> None:
    """LoopError where a controller of ``own`` cannot take over in a loop that reads ``loop``; see ``adapted``."""
    differ = [*_basics(own, loop), *_steered(own, loop), *_measured(own, loop)]
    if differ:
        plants = f"the new controller (made for {own.case}) does not fit this loop (made for {loop.case})"
        raise LoopError(f"{plants}: {'; '.join(differ)}")


def _basics(own: Manifest, loop: Manifest) -> Iterator[str]:
    if own.period_s != loop.period_s:
        yield f"its period is {own.period_s:g} s, the loop's is {loop.period_s:g} s"
    if "dv" in own.inputs and "dv" not in loop.inputs:
        yield "it uses measured disturbances, which this loop does not judge; restart with it"


def _steered(own: Manifest, loop: Manifest) -> Iterator[str]:
    """Set points and MVs, which must be the same; MVs may have a part of the loop's range."""
    if [_what(s) for s in own.sp] != [_what(s) for s in loop.sp]:
        its, ours = _shown(own.sp), _shown(loop.sp)
        yield f"its set points are {its}, the loop's are {ours}, and both must be the same in name, unit and order"
    same = [(*_what(s), s.values) for s in own.mv] == [(*_what(s), s.values) for s in loop.mv]
    if not (same and all(o.low <= s.low and s.high <= o.high for s, o in zip(own.mv, loop.mv, strict=True))):
        yield (
            f"its MVs are {_shown(own.mv)}, the loop's are {_shown(loop.mv)}, and both must be the same in name, unit, "
            "values and order, with ranges within the loop's"
        )


def _measured(own: Manifest, loop: Manifest) -> Iterator[str]:
    """PVs and measured disturbances, of which it may leave some out."""
    controlled = len(loop.sp)
    for name, words, first in (("pv", "PVs", controlled), ("dv", "measured disturbances", 0)):
        ours, its = loop.signals(name), own.signals(name)
        known = [_what(s) for s in ours]
        if [_what(s) for s in its[:first]] != known[:first] or not {_what(s) for s in its} <= set(known):
            order = ", and must begin with those that are controlled, in the same order" if first else ""
            may = f"it may leave some of them out, but have no others{order}"
            yield f"its {words} are {_shown(its)}, the loop's are {_shown(ours)}: {may}"


def _seen_as(own: Manifest, loop: Manifest) -> Manifest:
    """``own`` with all PVs and measured disturbances of the loop, which goes on judging them as it did."""
    inputs = tuple(n for n in INPUTS if n in own.inputs or (n == "dv" and n in loop.inputs))
    if set(inputs) == set(own.inputs):
        inputs = own.inputs
    mv = tuple(replace(s, low=o.low, high=o.high) for s, o in zip(own.mv, loop.mv, strict=True))
    dv = _ranged(loop.dv, own.dv)
    ahead = None if own.ahead is None else own.ahead.with_disturbances(dv)
    return replace(own, pv=_ranged(loop.pv, own.pv), mv=mv, dv=dv, inputs=inputs, ahead=ahead)


def _ranged(loop: Sequence[Signal], own: Sequence[Signal]) -> tuple[Signal, ...]:
    known = {s.name: s for s in own}
    return tuple(known.get(s.name, s) for s in loop)


def _places(own: Sequence[Signal], loop: Sequence[Signal]) -> list[int]:
    names = [s.name for s in loop]
    return [names.index(s.name) for s in own]


def _picked(values: ArrayLike | None, places: Sequence[int], loop: Sequence[Signal], name: str) -> Array:
    vector = np.asarray(values)
    if vector.shape != (len(loop),):
        raise ContractError(f"{name} has the shape {vector.shape}; the loop has ({len(loop)},)")
    return np.asarray(vector[places])


def _what(s: Signal) -> tuple[object, ...]:
    return s.name, s.unit


def _shown(signals: Sequence[Signal]) -> str:
    return ", ".join(f"{s.name} [{s.unit}] {s.low:g}..{s.high:g}" for s in signals) or "none"
