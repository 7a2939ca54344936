"""Models as likely as a fitted one: parameters drawn from the covariance that the record leaves them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TypeVar

import numpy as np

from loopwright.pipeline.models.identified.dynamics import Dynamics, Stretch
from loopwright.pipeline.models.identified.output_error import residuals
from loopwright.pipeline.models.identified.sensitivities import sensitivity_sums
from loopwright.pipeline.plants.simulator import Array

FLAT = 1e-7
"""Eigenvalue of J'J, relative to the largest, below which a direction of the parameters changes no output."""

WORSE = 1.3
"""Free-run error over that of the fitted model above which a drawn one is no more as likely."""


Model = TypeVar("Model", bound=Dynamics)


def drawn(
    model: Model,
    starts: Sequence[Array],
    data: Sequence[Stretch],
    count: int,
    correction: float = 0.0,
    seed: int = 0,
) -> list[Model]:
    """At most ``count`` models drawn about ``model``, which is fitted to ``data`` from ``starts``.

        theta* = theta + (J'J)^+ sum_b xi_b (J_b' r_b - mean),   xi_b ~ N(0, 1)

    over blocks b of neighbouring rows: the sandwich covariance, in which the colour of the residual r counts. Draws
    whose free run explodes or errs much more are left out; where all do, the draw is halved, at most four times.

    Source: H. White, Maximum likelihood estimation of misspecified models, Econometrica 50 (1982) 1, eq. 3.2.
    """
    free = model.free()
    sums = sensitivity_sums(model, starts, data, free, correction)
    found = residuals(model, starts, data, correction)
    if sums is None or found is None or len(sums.of_blocks) < 3:
        return []
    n = len(sums.g)
    h, blocks = sums.h.copy(), np.array([b[:n] for b in sums.of_blocks])
    for cross, own, _ in sums.of_starts:
        h -= cross @ np.linalg.solve(own + 1e-9 * np.eye(len(own)), cross.T)
    values, vectors = np.linalg.eigh((h + h.T) / 2)
    kept = values > FLAT * values[-1]
    spread = (vectors[:, kept] / values[kept]) @ (vectors[:, kept].T @ (blocks - blocks.mean(axis=0)).T)
    limit = WORSE**2 * sum(float(np.vdot(r, r)) for r in found)
    rng = np.random.default_rng(seed)
    models = []
    for _ in range(count):
        step = spread @ rng.normal(size=len(blocks))
        for _ in range(5):
            theta = model.vector()
            theta[free] += step
            candidate = model.with_vector(theta)
            runs = residuals(candidate, starts, data, correction)
            if runs is not None and sum(float(np.vdot(r, r)) for r in runs) < limit:
                models.append(candidate)
                break
            step = step / 2
    return models
