"""How a state-space network is learnt: one step ahead, then running free."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, ClassVar

import numpy as np
import torch

from pipeline.errors import ModelError
from pipeline.metrics import per_region, r2, rmse
from pipeline.models.base import Model
from pipeline.models.part import Array, Learnt, Part, Regions, predict
from pipeline.models.state_space.state_space import StateSpace
from pipeline.models.state_space.state_windows import StateWindows
from pipeline.models.training.long_run import TRAINED, LongRun
from pipeline.models.training.network_parts import going_on, story, trainer_of
from pipeline.models.training.objectives import Samples
from pipeline.models.training.time_split import split_in_time
from pipeline.plants.signals import Signals
from pipeline.plants.simulator import Simulator
from pipeline.records.record import Record


@dataclass(frozen=True, kw_only=True)
class StateSpacePart(Part):
    """A state-space network over all process variables, which must be the plant's whole state.

    ``hidden`` widths. ``steps`` the periods of the free runs that are trained on after the fit of one step;
    1 leaves it at that. ``free_run_iterations`` limit the second training; None: as the first. ``long_run``
    the periods of the free runs, end to end over the validation data, by whose fit the networks are judged
    before and after. ``train_fraction`` of the record trains, the rest validates.
    ``trainer`` {kind: lm | lbfgs | adam, and its options}.
    """

    model: ClassVar[type[Model]] = StateSpace
    hidden: tuple[int, ...] = (20,)
    steps: int = 50
    free_run_iterations: int | None = None
    long_run: int = 1000
    train_fraction: float = 0.7
    trainer: Mapping[str, Any] = field(default_factory=lambda: {"kind": "lm"})

    def __post_init__(self) -> None:
        for name in ("steps", "long_run"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name} is {getattr(self, name)}; it must be at least 1")

    def learn(
        self, record: Record | None, signals: Signals, regions: Regions, seed: int, plant: Simulator | None = None
    ) -> Learnt:
        """Train with early stopping on the last part of the record, which the figures are of.

        ``state_space`` of the metrics holds, of each PV, the one-step RMSE and the fit of a long free run,
        for the network trained on one step and for the one that is kept.
        """
        if record is None:
            raise ModelError("a part of kind 'state_space' learns from a record; point `data:` of its set at one")
        train, validation = split_in_time(record, self.train_fraction)
        (x, y), (x_held, y_held) = one_step_pairs(train), one_step_pairs(validation)
        model = StateSpace.scaled_to(x, y, hidden=self.hidden)
        trainer = trainer_of(self.trainer)
        history = trainer.fit(model.net, Samples(x, y), Samples(x_held, y_held), seed=seed)
        runs = {TRAINED[0]: self._run(model, validation)}
        if self.steps > 1:
            before, after = (StateWindows.of(r, self.steps, every=self.steps) for r in (train, validation))
            history = going_on(trainer, self.free_run_iterations).fit(model.net, before, after, seed=seed)
            runs[TRAINED[1]] = self._run(model, validation)
        model.eval()
        names = [s.name for s in signals.pv]
        figures = {trained: run.figures(names) for trained, run in runs.items()}
        cv, predicted = y_held[:, 0], predict(model, x_held)[:, 0]
        by_region = per_region(rmse, cv, predicted, x_held[:, 0], regions)
        metrics = {
            "rmse": rmse(cv, predicted),
            "r2": r2(cv, predicted),
            "free_run_rmse": figures[list(figures)[-1]][names[0]]["free_run_rmse"],
            "regions": {name: {"rmse": error} for name, error in by_region.items()},
            "state_space": figures,
            "n_train": len(train),
            **story(model, history),
        }
        return Learnt(model, metrics)

    def _run(self, model: StateSpace, validation: Record) -> LongRun:
        x, y = one_step_pairs(validation)
        cut = StateWindows.of(validation, self.long_run, every=self.long_run)
        with torch.no_grad():
            free = model.simulate(torch.from_numpy(cut.start), torch.from_numpy(cut.mv))
        return LongRun((y, predict(model, x)), cut.future, free.numpy())


def one_step_pairs(record: Record) -> tuple[Array, Array]:
    """(x (N, n_pv + n_mv), y (N, n_pv)): PVs and MVs of a sample, and the PVs one period later in the same run."""
    k = record.starts(1)
    return np.hstack([record.pv[k], record.mv[k]]), record.pv[k + 1]
