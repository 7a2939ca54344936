"""Trainers of an MLP: Levenberg-Marquardt, L-BFGS, Adam; one signature, early stopping, restarts."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import torch
from torch import Tensor
from torch.nn.utils import parameters_to_vector, vector_to_parameters

from loopwright.pipeline.errors import ModelError
from loopwright.pipeline.models.static.mlp import MLP
from loopwright.pipeline.models.training.objectives import Objective

Progress = Callable[[int, float, float], None]  # iteration, train RMSE, validation RMSE


@dataclass(frozen=True, slots=True)
class FitHistory:
    """One fit: RMSE of the scaled outputs after every iteration of the best restart.

    ``best`` is the iteration whose parameters the network was left with; ``stopped`` says why the restart ended.
    """

    train: tuple[float, ...]
    validation: tuple[float, ...]
    best: int
    stopped: str


@dataclass(frozen=True)
class Trainer(ABC):
    """Options shared by all trainers.

    A smooth map of few inputs learns nothing more from 100,000 rows than from 10,000, and the time is proportional
    to the rows: ``rows`` limits them.
    """

    iterations: int = 200  # at most so many per restart (epochs, for Adam)
    patience: int = 20  # stop after so many iterations without a validation RMSE lower by ``gain``
    gain: float = 1e-3  # relative improvement that counts as one
    restarts: int = 1  # fits from new random weights, the best by validation stays; 0 continues from the present ones
    rows: int = 0  # train on so many rows drawn at random; 0 for all
    name: ClassVar[str]

    def fit(
        self, net: MLP, train: Objective, validation: Objective, *, seed: int, progress: Progress | None = None
    ) -> FitHistory:
        """Train ``net`` in place and leave it with the parameters that were best on ``validation``.

        An NNARX is trained through its ``net``, on ``Samples`` or ``Windows``. Raises ModelError
        if no restart gives a finite error.
        """
        if 0 < self.rows < len(train):
            train = train.part(np.random.default_rng(seed).permutation(len(train))[: self.rows])
        best: tuple[float, Tensor, FitHistory] | None = None
        for restart in range(max(1, self.restarts)):
            generator = torch.Generator().manual_seed(seed * 1_000 + restart)
            if self.restarts:
                net.reset(generator)
            error, theta, history = self._one(net, train, validation, generator, progress)
            if math.isfinite(error) and (best is None or error < best[0]):
                best = (error, theta, history)
        if best is None:
            raise ModelError(
                f"trainer {self.name!r} found no finite validation error in {max(1, self.restarts)} restarts; "
                "check the training data's range and lower the learning rate"
            )
        vector_to_parameters(best[1], net.parameters())
        return best[2]

    def _one(
        self,
        net: MLP,
        train: Objective,
        validation: Objective,
        generator: torch.Generator,
        progress: Progress | None,
    ) -> tuple[float, Tensor, FitHistory]:
        rows: list[tuple[float, float]] = []  # train, validation
        best, best_at, mark, mark_at = math.inf, 0, math.inf, 0
        theta = parameters_to_vector(net.parameters()).detach().clone()
        stopped = "converged"
        for i, loss in enumerate(self._iterate(net, train, generator)):
            with torch.no_grad():
                error = math.sqrt(float(validation.loss(net)))
            rows.append((math.sqrt(loss), error))
            if progress is not None:
                progress(i, rows[-1][0], error)
            if error < best:
                best, best_at = error, i
                theta = parameters_to_vector(net.parameters()).detach().clone()
            if error < mark * (1 - self.gain):
                mark, mark_at = error, i
            if i - mark_at >= self.patience or not math.isfinite(error):
                stopped = "patience" if math.isfinite(error) else "diverged"
                break
            if i + 1 == self.iterations:
                stopped = "iterations"
                break
        losses, errors = zip(*rows, strict=True) if rows else ((), ())
        return best, theta, FitHistory(losses, errors, best_at, stopped)

    @abstractmethod
    def _iterate(self, net: MLP, train: Objective, generator: torch.Generator) -> Iterator[float]:
        """Improve ``net`` in place; yield the training loss after every iteration."""


@dataclass(frozen=True)
class LevenbergMarquardt(Trainer):
    """Damped Gauss-Newton with Nielsen's damping rule.

        (J'J + mu I) step = -J'r

    Only a step that lowers the training loss counts as an iteration. With the gain ratio
    q = (the loss's decrease) / (the decrease that the linear model promised), mu is multiplied by
    max(1/3, 1 - (2 q - 1)^3) after a success and by 2, 4, 8, ... after failures. Marquardt's
    scaling, diag(J'J) in place of I, is not used: it lets units that are nearly saturated wander,
    and on networks it stalls.

    Source: K. Madsen, H. B. Nielsen, O. Tingleff, Methods for non-linear least squares problems,
    2nd ed., DTU 2004, algorithm 3.16.
    """

    mu: float = 1e-3  # damping of the first iteration, relative to the largest entry of diag(J'J)
    chunk: int = 1024  # rows whose Jacobian is held at a time
    name: ClassVar[str] = "lm"

    def _iterate(self, net: MLP, train: Objective, generator: torch.Generator) -> Iterator[float]:
        theta = parameters_to_vector(net.parameters()).detach().clone()
        unit = torch.eye(len(theta), dtype=theta.dtype)
        mu, grow = math.nan, 2.0
        while True:
            loss, gradient, hessian = train.normal_equations(net, self.chunk)
            if math.isnan(mu):
                mu = self.mu * float(hessian.diagonal().max())
            ceiling = 1e8 * float(hessian.diagonal().max())
            while True:
                factor, failed = torch.linalg.cholesky_ex(hessian + mu * unit)
                if not int(failed):
                    step = -torch.cholesky_solve(gradient[:, None], factor)[:, 0]
                    vector_to_parameters(theta + step, net.parameters())
                    with torch.no_grad():
                        trial = float(train.loss(net))
                    promised = float(step @ (mu * step - gradient))
                    ratio = (float(loss) - trial) / max(promised, 1e-300)
                    if ratio > 0:
                        break
                mu, grow = mu * grow, grow * 2
                if not mu < ceiling:  # no step lowers the loss any more: a minimum, to rounding
                    vector_to_parameters(theta, net.parameters())
                    return
            theta = theta + step
            yield trial
            mu, grow = mu * max(1 / 3, 1 - (2 * ratio - 1) ** 3), 2.0


@dataclass(frozen=True)
class LBFGS(Trainer):
    """Limited-memory BFGS with a strong Wolfe line search on the whole training set."""

    memory: int = 30  # past steps that stand for the curvature
    name: ClassVar[str] = "lbfgs"

    def _iterate(self, net: MLP, train: Objective, generator: torch.Generator) -> Iterator[float]:
        optimizer = torch.optim.LBFGS(
            net.parameters(),
            max_iter=1,
            max_eval=25,
            history_size=self.memory,
            tolerance_grad=0.0,
            tolerance_change=0.0,
            line_search_fn="strong_wolfe",
        )

        def closure() -> float:
            optimizer.zero_grad()
            loss = train.loss(net)
            loss.backward()  # type: ignore[no-untyped-call]
            return float(loss.detach())

        before = math.inf
        while True:
            start = optimizer.step(closure)  # type: ignore[no-untyped-call]
            if not start < before:
                return
            before = start
            yield start


@dataclass(frozen=True)
class Adam(Trainer):
    """Adam on shuffled batches, its learning rate falling to zero along a cosine."""

    iterations: int = 400
    patience: int = 400
    rate: float = 1e-2  # learning rate at the start
    batch: int = 256  # rows a step
    name: ClassVar[str] = "adam"

    def _iterate(self, net: MLP, train: Objective, generator: torch.Generator) -> Iterator[float]:
        optimizer = torch.optim.Adam(net.parameters(), lr=self.rate)
        schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, self.iterations)
        n = len(train)
        while True:
            order = torch.randperm(n, generator=generator).numpy().astype(np.int64)
            total = 0.0
            for start in range(0, n, self.batch):
                rows = order[start : start + self.batch]
                optimizer.zero_grad()
                loss = train.part(rows).loss(net)
                loss.backward()  # type: ignore[no-untyped-call]
                optimizer.step()
                total += float(loss.detach()) * len(rows) / n
            schedule.step()
            yield total


TRAINERS: dict[str, type[Trainer]] = {t.name: t for t in (LevenbergMarquardt, LBFGS, Adam)}
