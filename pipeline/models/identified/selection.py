"""Structure search: linear candidates, then networks on the best of them, ranked by free runs over held-out rows."""

from __future__ import annotations

import statistics
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from pipeline.errors import ModelError
from pipeline.models.identified.candidates import Structure, Training, misses, wild
from pipeline.models.identified.output_error import Fitted

SEEDS = 3
"""Seeds of each network that reaches the last round."""

UNITS = (4, 8, 12)
"""Tanh units on offer."""

RIDGES = (1.0, 30.0)
"""Weights of the ridge on offer: the first in all rounds, the others for the winner."""

LAGS = ((2, 2), (3, 3), (2, 5))
"""Lags of the outputs and of the inputs on offer."""

INTEGRATES = 0.997
"""Pole of the linear model beyond which the training run is corrected slowly, as for drift."""

SLOW = 0.05
"""That correction."""

NEARLY = 1.02
"""Relative error up to which candidates of the first round count as equal, the smaller ones first."""

DRIFTS = 1.5
"""Residual over noise of the best network above which the correction is tried."""

GAIN = 0.01
"""Least relative gain of a network over the linear model, beside its spread."""

WHITE = 1.01
"""Residual over noise up to which a linear model leaves nothing to gain, so that no network is tried."""


@dataclass(frozen=True, slots=True, eq=False)
class Trial:
    """A candidate and its fits by (fold, seed)."""

    structure: Structure
    fits: dict[tuple[int, int], Fitted] = field(default_factory=dict)

    def of_fold(self, fold: int) -> list[Fitted]:
        """The fits of one fold, the best held-out error first."""
        return sorted((f for (of, _), f in self.fits.items() if of == fold), key=lambda f: f.held_out)

    @property
    def error(self) -> float:
        """The rms over the folds of the median over the seeds of the held-out free-run error, scaled."""
        medians = [statistics.median(f.held_out for f in self.of_fold(k)) for k in self._folds]
        return float(np.sqrt(np.mean(np.square(medians))))

    @property
    def spread(self) -> float:
        """The rms over the folds of the seeds' standard deviation, exploded ones left out; 0 for one seed."""
        finite = [[f.held_out for f in self.of_fold(k) if np.isfinite(f.held_out)] for k in self._folds]
        if not all(finite):
            return np.inf
        return float(np.sqrt(np.mean([np.var(errors) for errors in finite])))

    @property
    def _folds(self) -> list[int]:
        return sorted({k for k, _ in self.fits})


@dataclass(frozen=True, slots=True, eq=False)
class Selection:
    """The outcome of a search: the best linear candidate, the best network (None without one), and all finalists."""

    linear: Trial
    network: Trial | None
    finalists: list[Trial]
    spent: float  # nominal seconds

    @property
    def nonlinear(self) -> bool:
        """Whether the network wins by more than its spread, and by more than ``GAIN``."""
        if self.network is None:
            return False
        return self.network.error + max(self.network.spread, GAIN * self.linear.error) < self.linear.error

    @property
    def chosen(self) -> Trial:
        """The network where it wins by more than its spread, else the linear model."""
        return self.network if self.network is not None and self.nonlinear else self.linear

    @property
    def factor(self) -> float:
        """Held-out error of the linear model over that of the best network; 1 where no network was tried."""
        return self.linear.error / self.network.error if self.network is not None else 1.0


def select(
    training: Training, *, orders: Sequence[int], units: Sequence[int] = UNITS, correction: float | None = None
) -> Selection:
    """The search over one record.

    Linear candidates first: balanced starts of each order with and without the dead times that the impulse
    response shows, and lagged starts. Then networks on the best of them: a short training on one fold ranks them, the
    best two are trained with ``SEEDS`` seeds on both folds. When the budget is spent, what there is decides.
    ``correction`` None: ``SLOW`` where the linear model integrates or the best network misses more than drift-free
    rows would, else 0. Raises ModelError where no candidate can be fitted.
    """
    given = 0.0 if correction is None else correction
    shortlist = _linear_round(training, orders, given)
    if correction is None and given == 0.0 and _integrates(shortlist[0]):
        given = SLOW
        shortlist = _linear_round(training, orders, given)
    linear = _finish_linear(training, shortlist)
    finalists = _networks(training, linear, units) if _misses(training, linear[0], WHITE) else []
    best = min(finalists, key=lambda t: t.error) if finalists else None
    if correction is None and given == 0.0 and best is not None and _misses(training, best, DRIFTS):
        slow = [replace(t.structure, correction=SLOW) for t in linear[:2]]
        corrected = _finish_linear(training, [_linear_trial(training, s, 15) for s in slow])
        again = [_last_round(training, [replace(best.structure, correction=SLOW)])[0]] if corrected else []
        if again and again[0].error < 0.8 * best.error:
            linear, finalists = corrected, again
    return Selection(linear[0], best_of(finalists), [*linear, *finalists], training.budget.spent)


def best_of(trials: Sequence[Trial]) -> Trial | None:
    """The trial of the least error that is finite; None without one."""
    finite = [t for t in trials if np.isfinite(t.error)]
    return min(finite, key=lambda t: t.error) if finite else None


# ---------------------------------------------------------------------- linear models
def _linear_trial(training: Training, structure: Structure, iterations: int) -> Trial:
    return Trial(structure, {(0, 0): training.linear(structure, 0, iterations)})


def _linear_round(training: Training, orders: Sequence[int], correction: float) -> list[Trial]:
    """The candidates after a short training on the first fold, best first, those that failed left out."""
    options = training.delay_options()
    none = options[0]
    structures = [Structure("balanced", n, (0, 0), d, correction=correction) for d in options for n in orders]
    n_y = training.data.y.shape[1]
    for y_lags, v_lags in LAGS:
        order = y_lags * n_y + (v_lags - 1) * len(none)
        structures.extend(Structure("lagged", order, (y_lags, v_lags), d, correction=correction) for d in options)
    trials: list[Trial] = []
    reasons = []
    for structure in structures:
        if trials and not training.budget.left:
            break
        try:
            trials.append(_linear_trial(training, replace(structure, ridge=0.0), 10))
        except ModelError as error:
            reasons.append(str(error))
    finite = [t for t in trials if np.isfinite(t.error)]
    limit = NEARLY * min((t.error for t in finite), default=np.inf)
    good = sorted(finite, key=lambda t: (t.error, 0) if t.error > limit else (0.0, t.structure.order))
    if not good:
        why = reasons[0] if reasons else "every free run over held-out rows explodes"
        raise ModelError(f"no linear model fits the record: {why}")
    return good


def _finish_linear(training: Training, shortlist: Sequence[Trial], most: int = 4) -> list[Trial]:
    """The best of the short list, both starts among them where both succeeded, trained to the end on both folds."""
    kept = list(shortlist[:most])
    for start in ("balanced", "lagged"):
        if not any(t.structure.start == start for t in kept):
            kept.extend([t for t in shortlist if t.structure.start == start][:1])
    finished = []
    for trial in kept:
        fits = {}
        for fold in range(len(training.folds)):
            try:
                fits[fold, 0] = training.linear(trial.structure, fold, 30)
            except ModelError:
                continue
        finished.append(Trial(trial.structure, fits) if fits else trial)
    finished.sort(key=lambda t: (len(t.fits) < len(training.folds), t.error))
    # Of those within 1 % the smallest: a state less is one less to mislead.
    near = [t for t in finished if t.error <= 1.01 * finished[0].error and len(t.fits) == len(finished[0].fits)]
    smallest = min(near, key=lambda t: (t.structure.order + sum(t.structure.delays), t.error))
    return [smallest, *(t for t in finished if t is not smallest)]


def _integrates(trial: Trial) -> bool:
    poles = np.linalg.eigvals(trial.fits[0, 0].model.a)
    return bool(np.abs(poles).max() > INTEGRATES)


# ---------------------------------------------------------------------- networks
def _networks(training: Training, linear: Sequence[Trial], units: Sequence[int]) -> list[Trial]:
    """The finalists among the networks; none where the budget is spent or no number of units is given."""
    if not units or not training.budget.left:
        return []
    quick: list[Trial] = []
    for structure in _offers(linear, units):
        if quick and training.budget.spent > 0.5 * training.budget.seconds:
            break
        try:
            quick.append(Trial(structure, {(0, 0): training.network(structure, 0, 0, 20)}))
        except ModelError:
            continue
    ranked = sorted((t for t in quick if np.isfinite(t.error)), key=lambda t: t.error)
    finalists = _last_round(training, [t.structure for t in ranked[:2]])
    best = best_of(finalists)
    if best is not None and training.budget.left:
        finalists += _last_round(training, [replace(best.structure, ridge=ridge) for ridge in RIDGES[1:]])
    return finalists


def _offers(linear: Sequence[Trial], units: Sequence[int]) -> list[Structure]:
    """Networks to try: units on the best two balanced and the best lagged candidate, and on a smaller one."""
    balanced = [t.structure for t in linear if t.structure.start == "balanced"]
    lagged = [t.structure for t in linear if t.structure.start == "lagged"]
    bases = [*balanced[:2], *lagged[:1], *balanced[2:3]]
    middle = units[len(units) // 2]
    first = [replace(b, n_hidden=middle, ridge=RIDGES[0]) for b in bases]
    rest = [replace(b, n_hidden=n, ridge=RIDGES[0]) for n in units if n != middle for b in bases[:3]]
    return [*first, *rest]


def _last_round(training: Training, structures: Sequence[Structure]) -> list[Trial]:
    """Trials over all folds and seeds; a network that goes wild at a rest counts as exploded."""
    trials: list[Trial] = []
    for structure in structures:
        if trials and not training.budget.left:
            break
        fits = {}
        for fold in range(len(training.folds)):
            for seed in range(SEEDS):
                fitted = training.network(structure, fold, seed, 50)
                if wild(fitted.model, training.data.v):
                    fitted = replace(fitted, held_out=np.inf)
                fits[fold, seed] = fitted
        trials.append(Trial(structure, fits))
    return trials


def _misses(training: Training, trial: Trial, ratio: float) -> bool:
    best = trial.of_fold(0)[0]
    return misses(best.model, best.starts, training.stretches(trial.structure, 0)[0], ratio, trial.structure.correction)
