"""The controller that has the plant, and the one that is tried beside it."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from loopwright.serving.controller import Controller, Step
from loopwright.serving.errors import LoopError
from loopwright.serving.fitted import fitted
from loopwright.serving.guard import Guard, Sample, refused
from loopwright.serving.manifest import Manifest
from loopwright.serving.successor import Successor

Array: TypeAlias = NDArray[np.float64]
Guards: TypeAlias = Sequence[Guard] | Callable[[Manifest], Sequence[Guard]]


class InCharge:
    """The controller in charge with the state of its law, its guards and the samples that they look back to.

    ``guards`` are a host's own, or what makes them for a controller's manifest: they are then made anew for each
    controller that takes over.
    """

    def __init__(self, controller: Controller, guards: Guards) -> None:
        self.controller = controller
        self.replaced: Controller | None = None  # the one that was in charge before the present one
        self.successor: Successor | None = None  # tried beside the controller
        self._made = guards if callable(guards) else None
        self.guards: tuple[Guard, ...] = tuple(guards(controller.manifest) if callable(guards) else guards)
        self._state = controller.cold_state()
        self._past = deque[Sample](maxlen=_longest(self.guards))
        self._before: tuple[Sample, ...] = ()  # the past of the present sample, for the successor

    def refusal(self, sample: Sample) -> str | None:
        """Why not to act on a sample; None where nothing speaks against it."""
        if not isinstance(sample, Sample):
            return f"the sample is of the type {type(sample).__name__}; it must be a Sample"
        if sample.fault:
            return sample.fault if isinstance(sample.fault, str) else str(sample.fault)
        return refused(self.guards, sample, self._past)

    def step(self, sample: Sample, sp: Array, applied: Array) -> Step:
        """One step of the law. It raises what the law raises; ``forget`` then, as the state is of no use any more."""
        self._before = tuple(self._past) if self.successor is not None else ()
        step = self.controller.step(sp=sp, pv=sample.pv, dv=sample.dv, mv_applied=applied, state=self._state)
        if self._past.maxlen:
            self._past.append(replace(sample, pv=np.array(sample.pv)))  # the host may reuse its array
        self._state = step.state
        return step

    def beside(self, sample: Sample, sp: Array, applied: Array) -> Array | None:
        """The successor's MV (n_mv,); once it is ready, it has the plant from the next scan on."""
        new = self.successor
        if new is None:
            return None
        new.step(sample, sp, applied, self._before)
        if new.ready:
            self.replaced, self.successor = self.controller, None
            self.controller, self._state = new.controller, new.state
            if self._made is not None:
                self.guards = tuple(new.guards)
                self._past = deque(self._past, maxlen=_longest(self.guards))
        return new.mv

    def swap(self, controller: Controller, trial: int, loop: Manifest) -> None:
        """Try ``controller``, in a loop that reads the signals of ``loop``; see ``ControlLoop.swap``."""
        if trial < 1:
            raise LoopError(f"trial is {trial}; a controller is tried for at least one scan")
        new = fitted(controller, loop)
        self.successor = Successor(new, trial, () if self._made is None else tuple(self._made(new.manifest)))

    def forget(self, reason: str) -> None:
        """No past any more."""
        self._past.clear()
        self.begin_cold(reason)

    def begin_cold(self, reason: str) -> None:
        """The laws know nothing of what was."""
        self._state = self.controller.cold_state()
        if self.successor is not None:
            self.successor.miss(reason)


def _longest(guards: Sequence[Guard]) -> int:
    """How many past samples the guards need."""
    return max((g.memory for g in guards), default=0)
