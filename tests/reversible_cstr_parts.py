"""The quick model set of the reversible CSTR: a state-space network of the sampled plant itself."""

from __future__ import annotations

import numpy as np

from loopwright.pipeline.laws.reference.reference_law import Training
from loopwright.pipeline.models import Model
from loopwright.pipeline.models.state_space import StateSpace
from loopwright.pipeline.models.training.fit import LevenbergMarquardt
from loopwright.pipeline.models.training.objectives import Samples
from loopwright.pipeline.plants.equations import EquationPlant

# What the laws of the reactor need to be trained quickly: good enough to hold their contract.
QUICK_PARAMS = {"training": Training(hidden=4, lanes=12, holds=1, hold=40, noise=0.002, iterations=4, restarts=1)}
LOW, HIGH = np.array([0.25, 365.0]), np.array([0.65, 430.0])


def parts(plant: EquationPlant) -> dict[str, Model]:
    """Learnt from single periods that start anywhere; good to about 1e-6 mol/l a period."""
    rng = np.random.default_rng(0)
    n, mv = 2_000, plant.mv_signals[0]
    x = np.column_stack([rng.uniform(LOW, HIGH, (n, 2)), rng.uniform(mv.low, mv.high, n)])
    p = np.tile(plant.parameters()[:, None], (1, n))
    after = np.array(plant.transition.map(n)(x[:, :2].T, x[:, 2:].T, np.zeros((0, n)), p)).T
    model = StateSpace.scaled_to(x, after, hidden=(10,))
    samples = Samples(x, after)
    LevenbergMarquardt(iterations=40).fit(model.net, samples, samples, seed=0)
    return {"state_space": model.eval()}
