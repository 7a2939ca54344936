"""Stability analysis, at design time, of a law that is blended over operating points."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import pairwise

import numpy as np

from loopwright.pipeline.engine.parallel import parallel_map
from loopwright.pipeline.laws.base import Analysis, ControlLaw
from loopwright.pipeline.plants.equations import EquationPlant
from loopwright.pipeline.plants.simulator import Array
from loopwright.pipeline.tuning.recovery import Recovery, Starts, other_rests, recover
from loopwright.pipeline.tuning.stability import FrozenLoops, pairwise_contraction, spectral_radius

BATCH = 500  # loops that run side by side in one piece
SAME = 1e-3  # relative difference of two states that count as one


@dataclass(frozen=True, slots=True)
class StabilityTest:
    """How the stability of a law is examined.

    ``between``: linear loops from one operating point to the next, both included. ``starts``: loops
    that begin anywhere between the states ``low`` and ``high`` (None: over the states' ranges; none
    where ``starts`` is 0), at any MV, their set points anywhere between the outer operating points;
    ``seed`` draws them. One has recovered when it stays within ``band`` [CV] (None: 1 % of the set
    point's range) for ``holding`` samples, before ``samples`` are over. The courses of the first
    ``watched`` are kept.
    """

    between: int = 9
    starts: int = 2_000
    low: tuple[float, ...] | None = None
    high: tuple[float, ...] | None = None
    seed: int = 1
    band: float | None = None
    holding: int = 50
    samples: int = 1_000
    watched: int = 60

    def __post_init__(self) -> None:
        for name, least in (("between", 2), ("starts", 0), ("holding", 1), ("samples", 1), ("watched", 0)):
            if not getattr(self, name) >= least:
                raise ValueError(f"{name} is {getattr(self, name)}; it must be at least {least}")
        if self.band is not None and not self.band > 0:
            raise ValueError(f"band is {self.band}; give the width in the CV's unit, above 0")
        low, high = self.low, self.high
        if low is None and high is None:
            return
        if low is None or high is None or len(low) != len(high) or any(a >= b for a, b in zip(low, high, strict=True)):
            raise ValueError(
                f"low is {low} and high is {high}; give both, a number of each for every state of the plant, each low "
                "below its high, or neither"
            )

    def box(self, plant: EquationPlant) -> tuple[tuple[float, ...], tuple[float, ...]]:
        """Least and largest states at which a loop starts, each (n_x,), in the plant's units."""
        low, high = zip(*((s.low, s.high) for s in plant.state_signals), strict=True)
        return self.low or low, self.high or high


def stability_analysis(law: ControlLaw, plant: EquationPlant, points: Sequence[float], test: StabilityTest) -> Analysis:
    """Frozen loops, Lyapunov functions of neighbouring points, and recoveries from many starts.

    ``points`` are the operating points [CV] that the law is blended over.
    """
    edges = np.sort(np.array(points))
    cvs = np.unique(np.concatenate([np.linspace(a, b, test.between) for a, b in pairwise(edges)]))
    loops = FrozenLoops.of(plant, law, law.n_state, cvs)
    matrices = loops.matrices()
    contraction = pairwise_contraction(matrices, cvs, list(edges))
    proven = ~np.isnan(contraction)
    sp = plant.sp_signals[0]
    # Beyond the outer points too, where one controller is alone.
    wide = np.linspace(sp.low, sp.high, 4 * len(cvs))[1:-1]
    radius = spectral_radius(FrozenLoops.of(plant, law, law.n_state, wide).matrices())
    figures = {
        "frozen_radius": float(spectral_radius(matrices).max()),
        "frozen_radius_over_range": float(radius.max()),
        "gain_margin": loops.gain_margin(),
        "lyapunov_pairs": float(proven.sum()),
        "neighbour_pairs": float(len(contraction)),
    }
    if proven.all():
        figures["lyapunov_contraction"] = float(contraction.max())
    arrays = {"frozen_cv": wide, "frozen_radius": radius, "points": edges, "contraction": contraction}
    notes = [_lyapunov_note(edges, proven)]
    if test.starts:
        recovered = _recoveries(law, plant, edges, test)
        figures, arrays = {**figures, **recovered.figures}, {**arrays, **recovered.arrays}
        notes += recovered.notes
    return Analysis(figures, arrays, tuple(notes))


def _lyapunov_note(edges: Array, proven: Array) -> str:
    words = (
        "A quadratic Lyapunov function shared by the linear loops from one operating point to the next, checked after "
        "the solver, proves that they stay stable however the operating point moves among them; it says nothing of "
        "steps so large that no linear loop describes them."
    )
    missing = [f"{a:.4g} to {b:.4g}" for a, b, ok in zip(edges, edges[1:], proven, strict=False) if not ok]
    return words + (f" None was found from {', '.join(missing)}." if missing else "")


def _batch(run: Callable[..., Recovery], item: tuple[Starts, int]) -> Recovery:
    starts, watched = item
    return run(starts, watched=watched)


def _recoveries(law: ControlLaw, plant: EquationPlant, edges: Array, test: StabilityTest) -> Analysis:
    rng, sp, mv = np.random.default_rng(test.seed), plant.sp_signals[0], plant.mv_signals[0]
    n, (low, high) = test.starts, test.box(plant)
    band = 0.01 * (sp.high - sp.low) if test.band is None else test.band
    starts = Starts(
        rng.uniform(low, high, (n, len(low))),
        rng.uniform(edges[0], edges[-1], (n, 1)),
        rng.uniform(mv.low, mv.high, (n, 1)),
    )

    run = partial(recover, plant, law, law.n_state, samples=test.samples, band=band, holding=test.holding)
    # The first batch has all whose courses are kept.
    batches = starts.batches(max(BATCH, test.watched))
    work = [(batch, test.watched if i == 0 else 0) for i, batch in enumerate(batches)]
    ended = Recovery.together(parallel_map(partial(_batch, run), work, f"{law.name}: loops from many starts"))
    minutes = plant.period_s / 60.0
    out = plant.measured(ended.end)[:, 0] > sp.high + 0.5 * (sp.high - sp.low)
    figures = {
        "starts": float(n),
        "recovered": float(ended.arrived.sum()),
        "left_range": float((out & ~ended.arrived).sum()),
    }
    if ended.arrived.any():
        figures["recovery_min"] = minutes * float(np.median(ended.samples[ended.arrived]))
    arrays = {
        "start": starts.x,
        "start_sp": starts.sp,
        "arrived": ended.arrived.astype(float),
        "end": ended.end,
        "courses": ended.courses,
    }
    rests = other_rests(plant)
    if not len(rests):
        return Analysis(figures, arrays)
    middle = 0.5 * (edges[0] + edges[-1])
    ends = np.full((len(rests), 1), middle), np.full((len(rests), 1), mv.low)
    back = run(Starts(rests, *ends), watched=len(rests))
    arrays |= {"other_rest": rests, "other_rest_courses": back.courses}
    arrays["other_rest_arrived"] = back.arrived.astype(float)
    # Several of them may lead to one: a reactor that has gone out rests elsewhere under another MV.
    kept: list[Array] = []
    cv = plant.measured(back.end)[:, 0]
    # What swings within the range does not arrive either, and yet came back.
    for state in back.end[~back.arrived & ((cv < sp.low) | (cv > sp.high))]:
        if all(np.abs(state / known - 1).max() > SAME for known in kept):
            kept.append(state)
    figures["states_of_no_return"] = float(len(kept))
    names = ", ".join(s.name for s in plant.state_signals)
    where = "; ".join(", ".join(f"{v:.4g}" for v in state) for state in kept)
    note = "Beyond the set point's range the plant has a state from which the law does not return"
    return Analysis(figures, arrays, (f"{note}: ({names}) = {where}.",) if kept else ())
