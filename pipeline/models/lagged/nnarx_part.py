"""How an NNARX is learnt: one step ahead, then running free, in the lags and the size that validate best."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any, ClassVar

import torch

from pipeline.config.params import choose
from pipeline.errors import ModelError
from pipeline.metrics import fit_percent, per_region, r2, rmse
from pipeline.models.base import Model
from pipeline.models.lagged.lag_search import SLACK, Candidate, Size, parsimonious
from pipeline.models.lagged.nnarx import NNARX
from pipeline.models.lagged.one_step import FORGETTING, compare_one_step
from pipeline.models.part import Learnt, Part, Regions, predict
from pipeline.models.training.fit import FitHistory, Trainer
from pipeline.models.training.long_run import TRAINED, LongRun, curves
from pipeline.models.training.network_parts import going_on, story, trainer_of
from pipeline.models.training.objectives import Samples, Windows
from pipeline.models.training.regressors import nnarx_pairs
from pipeline.models.training.time_split import longest_run, split_in_time
from pipeline.plants.signals import Signals
from pipeline.plants.simulator import Simulator
from pipeline.records.record import Record


@dataclass(frozen=True, kw_only=True)
class NnarxPart(Part):
    """An NNARX predictor of ``target`` (None: the controlled variable) from lags.

    ``n_y``, ``n_u``, ``delay`` the lags; ``hidden`` the widths. ``steps`` the prediction horizon that is
    trained on: 1 is the one-step error, more a free run of that many periods, begun from the one-step fit.
    ``search`` lists sizes, e.g. [{n_y: 2, n_u: 2}, {n_y: 3, n_u: 3, hidden: [15]}], each trained alike;
    the smallest of those whose free run over ``free_run`` periods errs at most ``slack`` (relative) more
    than the best one's stays. Measurement noise counts in that error: where it dominates, take less slack.
    ``long_run`` periods of free runs, end to end over the validation data, whose fit is told for the network
    trained on one step and for the one that is kept; 0 for none. ``free_run_iterations`` limit the second
    training; None: as the first.
    ``residual`` has the network learn the change from one sample to the next instead of the level. ``train_fraction``
    of the record train, the rest validates. ``trainer`` names a trainer by ``kind`` (lm, lbfgs, adam) and its numbers.
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
    slack: float = SLACK
    long_run: int = 0
    free_run_iterations: int | None = None
    compared: int = 200
    forgetting: tuple[float, ...] = FORGETTING
    train_fraction: float = 0.7
    trainer: Mapping[str, Any] = field(default_factory=lambda: {"kind": "lm"})

    def __post_init__(self) -> None:
        for name, least in (("steps", 1), ("free_run", 1), ("compared", 0), ("long_run", 0), ("slack", 0.0)):
            if not getattr(self, name) >= least:
                raise ValueError(f"{name} is {getattr(self, name)}; it must be at least {least:g}")

    def learn(
        self, record: Record | None, signals: Signals, regions: Regions, seed: int, plant: Simulator | None = None
    ) -> Learnt:
        """Train each size with early stopping on the last part of the record; the figures are of the one that stays.

        They are of one step (by the region of the target, too) and of a free run. Validation data stop the
        training and choose the size, so they flatter both a little.
        """
        if record is None:
            raise ModelError("a part of kind 'nnarx' learns from a record; point `data:` of its set at one")
        names = {s.name: i for i, s in enumerate(signals.pv)}
        target = 0 if self.target is None else choose(names, self.target, "process variable", "target")
        halves = split_in_time(record, self.train_fraction)
        sizes = [self._sized(size) for size in self.search or (Size(),)]
        back = max(max(s.n_y - 1, s.n_u + s.delay - 2) for s in sizes)
        trials = [size._trial(*halves, target, back, seed) for size in sizes]
        best = parsimonious([candidate for *_, candidate in trials], self.slack)
        model, history, runs, candidate = trials[best]
        metrics = {
            "free_run_rmse": candidate.free_run_rmse,
            **self._scored(model, halves[1], target, regions),
            "n_train": len(halves[0]),
            "n_y": candidate.n_y,
            "n_u": candidate.n_u,
            **story(model, history),
        }
        if self.search:
            metrics["candidates"] = [c.row(i == best) for i, (*_, c) in enumerate(trials)]
        if runs:
            metrics["nnarx"] = {name: run.figures([signals.pv[target].name]) for name, run in runs.items()}
        if not self.compared:
            return Learnt(model, metrics, predictions=curves(runs, signals.period_s) if runs else None)
        shown = compare_one_step(
            model, longest_run(halves[1], self.compared), target=target, forgetting=self.forgetting
        )
        return Learnt(model, metrics | {"one_step": shown.sse()}, predictions=shown.curves())

    def _sized(self, size: Size) -> NnarxPart:
        changed = {"n_y": size.n_y, "n_u": size.n_u, "hidden": size.hidden}
        return replace(self, search=(), **{k: v for k, v in changed.items() if v is not None})  # type: ignore[arg-type]

    def _trial(
        self, train: Record, validation: Record, target: int, back: int, seed: int
    ) -> tuple[NNARX, FitHistory, dict[str, LongRun], Candidate]:
        lags = (self.n_y, self.n_u, target, self.delay)
        fitted, held = nnarx_pairs(train, *lags), nnarx_pairs(validation, *lags)
        model = NNARX.scaled_to(
            fitted.x,
            fitted.y,
            n_y=self.n_y,
            n_u=self.n_u,
            delay=self.delay,
            hidden=self.hidden,
            residual=self.residual,
        )
        trainer = trainer_of(self.trainer)
        history = trainer.fit(model.net, Samples(fitted.x, fitted.y), Samples(held.x, held.y), seed=seed)
        runs = {TRAINED[0]: self._long(model, validation, target)} if self.long_run else {}
        if self.steps > 1:
            history = self._run_free(model, trainer, train, validation, target, seed)
            if self.long_run:
                runs[TRAINED[1]] = self._long(model, validation, target)
        model.eval()
        free = Windows.of(
            validation, self.n_y, self.n_u, self.free_run, target=target, delay=self.delay, least_back=back
        )
        with torch.no_grad():
            error = float(free.loss(model.net).sqrt() * model.net.y_scale)
        size = sum(p.numel() for p in model.parameters())
        one_step = rmse(held.y, predict(model, held.x))
        return model, history, runs, Candidate(self.n_y, self.n_u, self.hidden, size, one_step, error)

    def _run_free(
        self, model: NNARX, trainer: Trainer, train: Record, validation: Record, target: int, seed: int
    ) -> FitHistory:
        """Go on from the one-step fit: a free run of random weights leads nowhere."""
        # End to end, each sample once: all windows cost ``steps`` times as much and validate no better.
        before, after = (
            Windows.of(r, self.n_y, self.n_u, self.steps, target=target, delay=self.delay, every=self.steps)
            for r in (train, validation)
        )
        return going_on(trainer, self.free_run_iterations).fit(model.net, before, after, seed=seed)

    def _long(self, model: NNARX, validation: Record, target: int) -> LongRun:
        pairs = nnarx_pairs(validation, model.n_y, model.n_u, target, model.delay)
        cut = Windows.of(
            validation, model.n_y, model.n_u, self.long_run, target=target, delay=model.delay, every=self.long_run
        )
        with torch.no_grad():
            free = model.simulate(torch.from_numpy(cut.past), torch.from_numpy(cut.u))
        return LongRun((pairs.y, predict(model, pairs.x)), cut.future[..., None], free[..., None].numpy())

    def _scored(self, model: NNARX, validation: Record, target: int, regions: Regions) -> dict[str, Any]:
        pairs = nnarx_pairs(validation, model.n_y, model.n_u, target, model.delay)
        predicted = predict(model, pairs.x)
        by_region = per_region(rmse, pairs.y, predicted, pairs.x[:, 0], regions)
        return {
            "rmse": rmse(pairs.y, predicted),
            "r2": r2(pairs.y, predicted),
            "fit_percent": fit_percent(pairs.y, predicted),
            "regions": {name: {"rmse": error} for name, error in by_region.items()},
        }
