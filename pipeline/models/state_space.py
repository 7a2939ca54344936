"""State-space network: a plant whose whole state is measured, one period later; learnt one step ahead, then free."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, ClassVar, Self

import numpy as np
import torch
from torch import Tensor

from loopwright.pipeline.errors import ModelError
from loopwright.pipeline.models.base import Model, simulate
from loopwright.pipeline.models.part import Learnt, Part, Source, accuracy, predict
from loopwright.pipeline.models.static.mlp import MLP
from loopwright.pipeline.models.training.network_parts import LongRun, fit_figures, fit_in_two, trainer_of
from loopwright.pipeline.models.training.objectives import (
    JacobianSums,
    Rows,
    Samples,
    check_finite,
    chunks,
    input_jacobian,
    parameter_jacobian,
)
from loopwright.pipeline.models.training.regressors import split_in_time
from loopwright.pipeline.plants.simulator import Array
from loopwright.pipeline.records.record import Record


@dataclass(frozen=True, slots=True, eq=False)
class StateWindows(Rows):
    """Free-run error of a state-space network over k steps: mean over windows, steps and PVs of (x - x*)^2 / s^2.

    Each window starts from what was measured and is then fed its own predictions; s is the network's
    output scale, so that k = 1 is the one-step error. The Jacobian follows the recursion

        dx(t+1)/dtheta = dNN/dtheta(x(t), u(t)) + dNN/dx(x(t), u(t)) dx(t)/dtheta,   dx(0)/dtheta = 0

    Raises ModelError for shapes that do not match, no window, or a value that is not finite.
    """

    start: Array  # (N, n_pv) measured PVs at the start of each window
    mv: Array  # (N, k, n_mv) MVs held over the window's periods
    future: Array  # (N, k, n_pv) measured PVs at the periods' ends

    def __post_init__(self) -> None:
        shapes = self.start.shape, self.mv.shape, self.future.shape
        fits = [len(s) for s in shapes] == [2, 3, 3] and shapes[1][:2] == shapes[2][:2] and self.future.size > 0
        if not fits or shapes[0] != (shapes[2][0], shapes[2][2]):
            raise ModelError(f"windows have shapes {shapes}; give (N, n_pv), (N, k, n_mv), (N, k, n_pv) with N, k > 0")
        check_finite("windows", self.start, self.mv, self.future)

    @classmethod
    def of(cls, record: Record, steps: int, *, every: int = 1) -> Self:
        """Each ``every``-th of all windows of ``steps`` periods, none reaching over the end of a run.

        Raises RecordError where no run is long enough.
        """
        k = record.starts(steps)[::every]
        after = k[:, None] + np.arange(steps)
        return cls(record.pv[k], record.mv[after], record.pv[after + 1])

    @property
    def steps(self) -> int:
        """Periods per window, k."""
        return int(self.future.shape[1])

    def loss(self, net: MLP) -> Tensor:
        """Mean squared error of the free run, scaled."""
        x, mv, future = (torch.from_numpy(a) for a in (self.start, self.mv, self.future))
        total = x.new_zeros(())
        for step in range(self.steps):
            x = net(torch.cat([x, mv[:, step]], dim=1))
            total = total + (((x - future[:, step]) / net.y_scale) ** 2).sum()
        return total / self.future.size

    @torch.no_grad()
    def normal_equations(self, net: MLP, chunk: int) -> tuple[Tensor, Tensor, Tensor]:
        """(loss, J'r, J'J)."""
        start, mv, future = (torch.from_numpy(a) for a in (self.start, self.mv, self.future))
        root = self.future.size**-0.5 / net.y_scale  # (n_pv,)
        n_pv = start.shape[1]
        sums = JacobianSums(net)
        for rows in chunks(len(self), chunk):
            x, sensitivity = start[rows], None
            for step in range(self.steps):
                phi = torch.cat([x, mv[rows, step]], dim=1)
                s, jac = parameter_jacobian(net, phi)
                jac.mul_(net.y_scale[:, None])
                if sensitivity is not None:
                    slope = input_jacobian(net, phi)
                    for i in range(n_pv):
                        for j in range(n_pv):
                            jac[:, i].addcmul_(slope[:, i, j, None], sensitivity[:, j])
                x, sensitivity = x + net.y_center + net.y_scale * s, jac
                sums.add((x - future[rows, step]) * root, jac * root[:, None])
        return sums.result


# ----------------------------------------------------------------------------------------------------------- the model
class StateSpace(Model):
    """One-step predictor of a plant whose whole state is measured.

        x(k+1) = x(k) + NN(x(k), u(k))

    with x the process variables, u the manipulated ones held over [k, k+1). It needs no lags, so a free
    run forgets its start as the plant does. ``forward`` maps [x, u] (..., n_pv + n_mv) to x one period
    later (..., n_pv). Training goes through ``net``, whose hidden layers have the widths ``hidden``.

    Raises ModelError for ``n_pv`` or ``n_mv`` below 1, or no hidden unit.
    """

    kind: ClassVar[str] = "state_space"

    def __init__(self, n_pv: int, n_mv: int = 1, hidden: Sequence[int] = (20,)) -> None:
        super().__init__()
        if min(n_pv, n_mv) < 1:
            raise ModelError(f"a state-space network has n_pv={n_pv}, n_mv={n_mv}; each must be at least 1")
        self.n_pv, self.n_mv, self.hidden = n_pv, n_mv, tuple(hidden)
        self.net = MLP(n_pv + n_mv, n_pv, hidden, tuple(range(n_pv)))

    @classmethod
    def scaled_to(cls, x: Array, y: Array, *, hidden: Sequence[int] = (20,)) -> Self:
        """An untrained model scaled to rows [x(k), u(k)] (N, n_pv + n_mv) and x(k+1) (N, n_pv).

        Raises ModelError for a column that does not vary.
        """
        n_pv = y.shape[1]
        model = cls(n_pv, x.shape[1] - n_pv, hidden)
        model.net = MLP.scaled_to(x, y, hidden=hidden, residual=model.net.residual)
        return model

    def forward(self, x: Tensor) -> Tensor:
        """PVs one period later, shape (..., n_pv), for [PVs, MVs], shape (..., n_pv + n_mv)."""
        y: Tensor = self.net(x)
        return y


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

    def learn(self, source: Source) -> Learnt:
        """Train with early stopping on the last part of the record, which the figures are of.

        ``state_space`` of the metrics holds, of each PV, the one-step RMSE and the fit of a long free run,
        for the network trained on one step and for the one that is kept.
        """
        train, validation = split_in_time(source.data(self.model.kind), self.train_fraction)
        (x, y), (x_held, y_held) = one_step_pairs(train), one_step_pairs(validation)
        model = StateSpace.scaled_to(x, y, hidden=self.hidden)

        def long_run() -> LongRun:
            cut = StateWindows.of(validation, self.long_run, every=self.long_run)
            with torch.no_grad():
                free = simulate(model, torch.from_numpy(cut.start), torch.from_numpy(cut.mv))
            return LongRun((y_held, predict(model, x_held)), cut.future, free.numpy())

        free_run = [StateWindows.of(r, self.steps, every=self.steps) for r in (train, validation)]
        history, runs = fit_in_two(
            model.net,
            trainer_of(self.trainer),
            one_step=(Samples(x, y), Samples(x_held, y_held)),
            free_run=free_run if self.steps > 1 else None,
            free_run_iterations=self.free_run_iterations,
            seed=source.seed,
            long_run=long_run,
        )
        model.eval()
        names = [s.name for s in source.signals.pv]
        figures = {trained: run.figures(names) for trained, run in runs.items()}
        cv, predicted = y_held[:, 0], predict(model, x_held)[:, 0]
        metrics = {
            **accuracy(cv, predicted, x_held[:, 0], source.regions),
            "free_run_rmse": figures[list(figures)[-1]][names[0]]["free_run_rmse"],
            "state_space": figures,
            "n_train": len(train),
            **fit_figures(model, history),
        }
        return Learnt(model, metrics)


def one_step_pairs(record: Record) -> tuple[Array, Array]:
    """(x (N, n_pv + n_mv), y (N, n_pv)): PVs and MVs of a sample, and the PVs one period later in the same run."""
    k = record.starts(1)
    return np.hstack([record.pv[k], record.mv[k]]), record.pv[k + 1]
