"""How an NNARX is learnt: one step ahead, then running free; and its predictions beside those of linear models."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from typing import Any, ClassVar

import numpy as np
import torch

from loopwright.pipeline.engine.parallel import parallel_map
from loopwright.pipeline.errors import ModelError
from loopwright.pipeline.metrics import fit_percent, rmse
from loopwright.pipeline.models.base import Model
from loopwright.pipeline.models.lagged.instantaneous import linearize
from loopwright.pipeline.models.lagged.lagged import NNARX
from loopwright.pipeline.models.lagged.recursive_arx import RecursiveLeastSquares
from loopwright.pipeline.models.part import Learnt, Part, Source, accuracy, predict
from loopwright.pipeline.models.training.fit import FitHistory
from loopwright.pipeline.models.training.network_parts import LongRun, curves, fit_figures, fit_in_two, trainer_of
from loopwright.pipeline.models.training.objectives import Samples
from loopwright.pipeline.models.training.regressors import longest_run, nnarx_pairs, split_in_time
from loopwright.pipeline.plants.simulator import Array
from loopwright.pipeline.records.record import Record

ESTIMATE_FORGETTING = (0.8, 0.5)  # factors of the recursive estimates
VARIANCE = 100.0
"""Variance of a recursive model's parameters at the start: an open mind, for regressors of the order of one."""


@dataclass(frozen=True, slots=True)
class OneStep:
    """Predictions of each model beside the measurements that they predict, over the same samples."""

    time_s: Array  # (N,)
    measured: Array  # (N,) [unit of the PV]
    predicted: Mapping[str, Array]  # model -> (N,)

    def sse(self) -> dict[str, float]:
        """Sum of squared prediction errors of each model [unit of the PV, squared]."""
        return {name: float(((self.measured - p) ** 2).sum()) for name, p in self.predicted.items()}

    def curves(self) -> dict[str, Array]:
        """Arrays by name, as a picture wants them: time_s, measured, and one for each model."""
        return {"time_s": self.time_s, "measured": self.measured, **self.predicted}


def compare_one_step(
    model: NNARX,
    record: Record,
    *,
    target: int = 0,
    forgetting: Sequence[float] = ESTIMATE_FORGETTING,
    n_y: int | None = None,
    n_u: int | None = None,
    scaled: bool = True,
) -> OneStep:
    """Predict every sample of one run from the samples before it, by four kinds of model.

    With phi(t) the regressor of y(t), known at t - 1, and NN the network:

        nnarx         NN(phi(t))
        linearized    NN(phi(t-1)) + dNN/dphi(phi(t-1)) (phi(t) - phi(t-1))
        recursive_f   [phi(t), 1]' theta(t-1),  theta by least squares with forgetting factor f

    so the linearized model is the one that was right a sample ago, taken one sample further: its
    error is what a controller meets that tunes itself by it. The recursive models learn along the
    run from nothing. All are compared over the same samples.

    ``record`` holds one run, y is its PV ``target``. ``forgetting`` are the factors f of the recursive models and
    ``n_y``, ``n_u`` their lags, None for the network's; they take phi and y in the network's scaling where
    ``scaled``, otherwise in engineering units. Raises ModelError for a record of several runs, RecordError for one
    that is too short for the lags.

    Source: [chen2004, eqs. 9-11, figure 3 and Table 1]; the bias of eq. 12 has
    a wrong sign there, and here the linear model goes through the network's own value.
    """
    if (record.run != record.run[0]).any():
        raise ModelError("the one-step comparison follows one run, and this record holds several; pick one of them")
    own = model.pairs(record, target)
    phi = torch.from_numpy(own.x)
    linear = linearize(model, phi)
    ahead = linear.predict(torch.roll(phi, -1, dims=0) - phi)[:-1, 0].numpy()
    found = {"nnarx": (own.row, linear.value[:, 0].numpy()), "linearized": (own.row[1:], ahead)}
    n_y, n_u = n_y or model.n_y, n_u or model.n_u
    pairs = nnarx_pairs(record, n_y, n_u, target, model.delay)
    center, scale = np.zeros(pairs.x.shape[1]), np.ones(pairs.x.shape[1])
    if scaled:
        center, scale = _scaling(model, n_y, n_u)
    x, y = (pairs.x - center) / scale, (pairs.y[:, 0] - center[0]) / scale[0]
    for factor in forgetting:
        found[f"recursive_{factor:g}"] = (pairs.row, center[0] + scale[0] * _recursive(x, y, factor))
    first = max(int(row[0]) for row, _ in found.values())
    rows = np.arange(first, int(own.row[-1]) + 1)
    predicted = {name: values[row >= first] for name, (row, values) in found.items()}
    return OneStep(record.time_s[rows + 1], record.pv[rows + 1, target], predicted)


def _scaling(model: NNARX, n_y: int, n_u: int) -> tuple[Array, Array]:
    """The network's centre and scale of y and of each MV, repeated over other lags, (n_y + n_u n_mv,) each."""
    columns = np.r_[np.zeros(n_y, np.int64), np.repeat(model.n_y + model.n_u * np.arange(model.n_mv), n_u)]
    return model.net.x_center.numpy()[columns], model.net.x_scale.numpy()[columns]


def _recursive(x: Array, y: Array, forgetting: float) -> Array:
    """Predictions (N,) of y (N,) by [x, 1]' theta, x (N, n), each made before its row is learnt."""
    phi = torch.from_numpy(np.column_stack([x, np.ones(len(x))]))
    rls = RecursiveLeastSquares(forgetting)
    theta, root = torch.zeros(phi.shape[1], dtype=torch.float64), rls.start(phi.shape[1], VARIANCE)
    return np.asarray(rls.run(phi, torch.from_numpy(y), theta, root)[0].numpy())


SMALLER_MODEL_SLACK = 0.05
"""Relative free-run error above the best one that a smaller model may have."""


@dataclass(frozen=True, slots=True)
class Size:
    """Changes of a part by a candidate: lags and hidden widths; None leaves the part's own."""

    n_y: int | None = None
    n_u: int | None = None
    hidden: tuple[int, ...] | None = None


@dataclass(frozen=True, slots=True)
class SizeCandidate:
    """One row of the search: the model's size and its validation errors [unit of the PV].

    ``rmse`` is of one step, ``free_run_rmse`` of all steps of free runs over validation data.
    """

    n_y: int
    n_u: int
    hidden: tuple[int, ...]
    parameters: int
    rmse: float
    free_run_rmse: float


Trial = tuple[NNARX, FitHistory, dict[str, LongRun], SizeCandidate]


def parsimonious(candidates: Sequence[SizeCandidate], slack: float = SMALLER_MODEL_SLACK) -> int:
    """Index of the one with the fewest parameters among those within ``slack`` of the best free run.

    Differences of a few per cent between free-run errors lie within what another draw of the
    initial weights changes, and each parameter less is one less to mislead the model's slopes,
    by which controllers are tuned. The better free run wins among equal sizes.
    Raises ModelError without a candidate.
    """
    if not candidates:
        raise ModelError("a search over no candidates: list at least one size, or leave `search` out")
    limit = (1 + slack) * min(c.free_run_rmse for c in candidates)
    near = [i for i, c in enumerate(candidates) if c.free_run_rmse <= limit]
    return min(near, key=lambda i: (candidates[i].parameters, candidates[i].free_run_rmse))


@dataclass(frozen=True, kw_only=True)
class NnarxPart(Part):
    """An NNARX predictor of ``target`` (None: the controlled variable) from lags.

    ``n_y``, ``n_u``, ``delay`` the lags; ``hidden`` the widths. ``steps`` the prediction horizon that is
    trained on: 1 is the one-step error, more a free run of that many periods, begun from the one-step fit.
    ``search`` lists sizes, e.g. [{n_y: 2, n_u: 2}, {n_y: 3, n_u: 3, hidden: [15]}], each trained alike;
    the smallest of those whose free run over ``free_run`` periods errs at most ``slack`` (relative) more
    than the best one's stays. Measurement noise counts in that error: where it dominates, take less slack.
    ``long_run`` periods of free runs, end to end over the validation data, whose fit is reported for the network
    trained on one step and for the one that is kept; 0 for none. ``free_run_iterations`` limit the second
    training; None: as the first.
    ``residual`` has the network learn the change from one sample to the next instead of the level. ``train_fraction``
    of the record trains, the rest validates. ``trainer`` names a trainer by ``kind`` (lm, lbfgs, adam) and its numbers.
    ``forgetting`` are the factors of the recursive linear models that the one-step predictions are compared with.
    ``compared`` validation samples show the one-step predictions beside those of linear models; 0 none, which
    leaves the picture to the free runs.
    """

    model: ClassVar[type[Model]] = NNARX
    n_y: int = 2
    n_u: int = 2
    delay: int = 1
    target: str | None = None
    hidden: tuple[int, ...] = (10,)
    residual: bool = True
    steps: int = 1
    free_run: int = 20
    search: tuple[Size, ...] = ()
    slack: float = SMALLER_MODEL_SLACK
    long_run: int = 0
    free_run_iterations: int | None = None
    compared: int = 200
    forgetting: tuple[float, ...] = ESTIMATE_FORGETTING
    train_fraction: float = 0.7
    trainer: Mapping[str, Any] = field(default_factory=lambda: {"kind": "lm"})

    def __post_init__(self) -> None:
        for name, least in (("steps", 1), ("free_run", 1), ("compared", 0), ("long_run", 0), ("slack", 0.0)):
            if not getattr(self, name) >= least:
                raise ValueError(f"{name} is {getattr(self, name)}; it must be at least {least:g}")

    def learn(self, source: Source) -> Learnt:
        """Train each size with early stopping on the last part of the record; the figures are of the one that stays.

        They are of one step (by the region of the target, too) and of a free run. Validation data stop the
        training and choose the size, so they flatter both a little.
        """
        target = source.pv_index(self.target)
        train, validation = split_in_time(source.data(self.model.kind), self.train_fraction)
        sizes = [self._sized(size) for size in self.search or (Size(),)]
        back = max(max(s.n_y - 1, s.n_u + s.delay - 2) for s in sizes)
        given = (train, validation, target, back, source.seed)
        trials = parallel_map(partial(_trial_of, given), sizes, "fit: networks of each size")
        best = parsimonious([candidate for *_, candidate in trials], self.slack)
        model, history, runs, candidate = trials[best]
        pairs = model.pairs(validation, target)
        predicted = predict(model, pairs.x)
        metrics = {
            "free_run_rmse": candidate.free_run_rmse,
            **accuracy(pairs.y, predicted, pairs.x[:, 0], source.regions),
            "fit_percent": fit_percent(pairs.y, predicted),
            "n_train": len(train),
            "n_y": candidate.n_y,
            "n_u": candidate.n_u,
            **fit_figures(model, history),
        }
        if self.search:
            metrics["candidates"] = [{**asdict(c), "chosen": i == best} for i, (*_, c) in enumerate(trials)]
        if runs:
            metrics["nnarx"] = {name: run.figures([source.signals.pv[target].name]) for name, run in runs.items()}
        if not self.compared:
            return Learnt(model, metrics, predictions=curves(runs, source.signals.period_s) if runs else None)
        shown = compare_one_step(
            model, longest_run(validation, self.compared), target=target, forgetting=self.forgetting
        )
        return Learnt(model, metrics | {"one_step": shown.sse()}, predictions=shown.curves())

    def _sized(self, size: Size) -> NnarxPart:
        return replace(self, search=(), **{k: v for k, v in asdict(size).items() if v is not None})

    def _trial(self, train: Record, validation: Record, target: int, back: int, seed: int) -> Trial:
        lags = {"n_y": self.n_y, "n_u": self.n_u, "delay": self.delay}
        fitted, held = (nnarx_pairs(r, target=target, **lags) for r in (train, validation))
        model = NNARX.scaled_to(fitted.x, fitted.y, hidden=self.hidden, residual=self.residual, **lags)

        def long_run() -> LongRun:
            cut = model.windows(validation, self.long_run, target, every=self.long_run)
            free = model.free_run(cut)
            return LongRun((held.y, predict(model, held.x)), cut.future[..., None], free[..., None])

        one_step = [Samples(p.x, p.y) for p in (fitted, held)]
        # End to end, each sample once: all windows cost ``steps`` times as much and validate no better.
        free_run = [model.windows(r, self.steps, target, every=self.steps) for r in (train, validation)]
        history, runs = fit_in_two(
            model.net,
            trainer_of(self.trainer),
            one_step=one_step,
            free_run=free_run if self.steps > 1 else None,
            free_run_iterations=self.free_run_iterations,
            seed=seed,
            long_run=long_run if self.long_run else None,
        )
        model.eval()
        free = model.windows(validation, self.free_run, target, least_back=back)
        with torch.no_grad():
            error = float(free.loss(model.net).sqrt() * model.net.y_scale)
        size = sum(p.numel() for p in model.parameters())
        one_step_error = rmse(held.y, predict(model, held.x))
        return model, history, runs, SizeCandidate(self.n_y, self.n_u, self.hidden, size, one_step_error, error)


def _trial_of(given: tuple[Record, Record, int, int, int], size: NnarxPart) -> Trial:
    return size._trial(*given)
