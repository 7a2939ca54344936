"""The identification example: one-step prediction of a known difference equation by four kinds of model."""

from __future__ import annotations

import statistics
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from loopwright.pipeline.models.base import Model
from loopwright.pipeline.models.lagged.lagged import NNARX
from loopwright.pipeline.models.lagged.nnarx_part import ESTIMATE_FORGETTING, OneStep, compare_one_step
from loopwright.pipeline.models.part import Learnt, Part, Source
from loopwright.pipeline.models.training.network_parts import trainer_of
from loopwright.pipeline.models.training.objectives import Samples
from loopwright.pipeline.models.training.regressors import nnarx_pairs
from loopwright.pipeline.records.record import Record
from loopwright.serving.manifest import Signal

Array = NDArray[np.float64]

LAGS = (1, 1)  # those of the equation
RECURSIVE_LAGS = (2, 1)  # of lags up to 3, those whose recursive models come nearest to the published errors
SINE_PERIOD = 25
EDGE = 1.2  # training inputs reach beyond the sine's amplitude of 1, so that it does not run along the data's edge


def example_record(u: Array, noise: Array | None = None) -> Record:
    """The record of u (N,), from z(0) = 0, sampled every second; ``noise`` (N,) is added to z.

        z(t) = z(t-1) / (1 + z(t-1)^2) + u(t-1)^3,     y(t) = z(t) + v(t)

    Source: [chen2004, eq. 15], after Narendra and Parthasarathy, IEEE Trans.
    Neural Networks 1 (1990), 4.
    """
    n = len(u)
    z = np.zeros(n)
    for t in range(1, n):
        z[t] = z[t - 1] / (1 + z[t - 1] ** 2) + u[t - 1] ** 3
    y = z if noise is None else z + noise
    signals = (Signal("y", "-", -5.0, 5.0),), (Signal("u", "-", -EDGE, EDGE),), ()
    runs, time_s = np.zeros(n, dtype=np.int64), np.arange(n, dtype=np.float64)
    return Record(1.0, *signals, runs, time_s, y[:, None], u[:, None], np.empty((n, 0)))


@dataclass(frozen=True, kw_only=True)
class IdentificationExamplePart(Part):
    """NNARX, its linearization and recursive linear models over the identification example; needs no record.

    ``networks`` networks are trained, each on its own experiment of ``samples`` white inputs with
    measurement noise of standard deviation ``noise``, and compared over ``compared`` samples of
    u = sin(2 pi k / 25). The figures are median, least and largest over the networks:

    - ``one_step``: the sine without noise. Only so can the published errors have come about: with
      the published noise in the measurements every error would be at least N sigma^2, which is 1
      for sigma = 0.1 and N = 100.
    - ``one_step_noisy``: the sine with the training data's noise in regressors and measurements.
    - ``one_step_white``: white inputs without noise, from one sample to the next unrelated. The
      linearization of a sample ago is then taken far from where it holds.
    """

    model: ClassVar[type[Model]] = NNARX
    networks: int = 5
    samples: int = 3_000
    noise: float = 0.1
    compared: int = 100
    hidden: tuple[int, ...] = (10,)
    forgetting: tuple[float, ...] = ESTIMATE_FORGETTING
    train_fraction: float = 0.7
    trainer: Mapping[str, Any] = field(default_factory=lambda: {"kind": "lm", "iterations": 300})

    def learn(self, source: Source) -> Learnt:
        """Train and compare; the model and the curves are those of the network with the median error on the sine."""
        seeds = [source.seed * self.networks + i for i in range(self.networks)]
        models = [self._network(s) for s in seeds]
        sine = np.sin(2 * np.pi * np.arange(self.compared) / SINE_PERIOD)
        plain = [self._compared(model, example_record(sine)) for model in models]
        noisy, white = [], []
        for s, model in zip(seeds, models, strict=True):
            rng = np.random.default_rng([s, 1])
            noisy.append(self._compared(model, example_record(sine, self.noise * rng.standard_normal(len(sine)))))
            white.append(self._compared(model, example_record(rng.uniform(-1, 1, self.compared))))
        metrics = {
            "one_step": summary(plain),
            "one_step_noisy": summary(noisy),
            "one_step_white": summary(white),
            "n_train": round(self.train_fraction * self.samples),
        }
        order = sorted(range(len(models)), key=lambda i: plain[i].sse()["nnarx"])
        middle = order[len(order) // 2]
        return Learnt(models[middle], metrics, predictions=plain[middle].curves())

    def _network(self, seed: int) -> NNARX:
        rng = np.random.default_rng([seed, 0])
        u, noise = rng.uniform(-EDGE, EDGE, self.samples), self.noise * rng.standard_normal(self.samples)
        pairs = nnarx_pairs(example_record(u, noise), *LAGS)
        train, held = pairs.split(self.train_fraction, "time", seed)
        model = NNARX.scaled_to(train.x, train.y, n_y=LAGS[0], n_u=LAGS[1], hidden=self.hidden)
        trainer_of(self.trainer).fit(model.net, Samples(train.x, train.y), Samples(held.x, held.y), seed=seed)
        return model.eval()

    def _compared(self, model: NNARX, record: Record) -> OneStep:
        n_y, n_u = RECURSIVE_LAGS
        return compare_one_step(model, record, forgetting=self.forgetting, n_y=n_y, n_u=n_u, scaled=False)


def summary(trials: Sequence[OneStep]) -> dict[str, dict[str, float]]:
    """Median, least and largest sum of squared errors of each model over some trials."""
    rows = [trial.sse() for trial in trials]
    reductions: dict[str, Callable[[Iterable[float]], float]] = {"median": statistics.median, "min": min, "max": max}
    return {name: {how: reduce(r[name] for r in rows) for how, reduce in reductions.items()} for name in rows[0]}
