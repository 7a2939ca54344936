"""How one candidate is fitted on one fold: pieces of work on values, which any process can do."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from loopwright.pipeline.errors import ModelError
from loopwright.pipeline.models.identified.dynamics import Dynamics, Stretch
from loopwright.pipeline.models.identified.fresh_errors import changes_of, deviation_of
from loopwright.pipeline.models.identified.innovations import (
    Innovations,
    PredictionError,
    begun,
    innovations,
    with_loads,
)
from loopwright.pipeline.models.identified.linear_start import (
    Realizations,
    dead_times,
    high_order_arx,
    lagged_start,
    output_rows,
    with_units,
    within_unit_circle,
)
from loopwright.pipeline.models.identified.output_error import (
    Fitted,
    OutputErrorFit,
    fit_starts,
    residuals,
)
from loopwright.pipeline.models.identified.residual_tests import error_beyond_drift
from loopwright.pipeline.models.identified.steady_states import INTEGRATES, settle, slowest_pole
from loopwright.pipeline.models.identified.structure import Problem, Structure
from loopwright.pipeline.plants.simulator import Array

RESPONSE = 120
"""Samples of the high-order ARX's impulse response that are realized."""


BEGIN, EASED = 15, 0.05
"""Iterations of each step in which a network's fit begins, and the correction of the runs of one of them."""

BEGINNING = 4 * BEGIN
"""Iterations before a network's fit at most."""

PATIENCE = 30
"""Iterations without a better held-out error that end a network's fit."""

RETURN_DISTANCE = 1.5
"""Distance of the states from their middle, over that of the visited ones, from which a usable network returns."""

HELD_INPUTS, RESTING_SHARE = 60, 0.9
"""Inputs that are held, and the least share of them under which a usable network comes to rest."""


# ---------------------------------------------------------------------- starts
@dataclass(frozen=True, slots=True, eq=False)
class FoldStart:
    """Where the balanced candidates of a fold start from, and the dead times that its impulse response shows."""

    realizations: Realizations
    dead_times: tuple[int, ...]


def find_start(problem: Problem, task: tuple[Structure, int]) -> FoldStart | str:
    """The start of a fold's balanced candidates under a structure's shifts; the reason where there is none."""
    structure, fold = task
    try:
        train = problem.part(structure, problem.folds[fold].train)
        response = problem.known.without(high_order_arx(train).impulse_response(RESPONSE))
        weight = problem.known.weights(train.v.std(axis=0))
        return FoldStart(Realizations.of(response, weight), tuple(dead_times(response, weight)))
    except ModelError as error:
        return str(error)


# ---------------------------------------------------------------------- fits
@dataclass(frozen=True, slots=True, eq=False)
class FitTask:
    """A fit of a structure on a fold: ``iterations`` more from ``begun``.

    Without ``begun`` a balanced candidate starts from ``start``, a lagged one from its least squares; a network from
    the linear model ``base``, its units drawn with ``seed``. ``last`` is false where a later round trains it on.
    """

    structure: Structure
    fold: int
    iterations: int
    seed: int = 0
    start: FoldStart | None = None
    base: Fitted | None = None
    begun: Fitted | None = None
    last: bool = True


def fit_candidate(problem: Problem, task: FitTask) -> Fitted | str:
    """The fitted candidate; the reason where the data cannot carry it.

    A network that explodes or swings under constant inputs, where the plant settles, counts as exploded, or before
    the last round as ``wild``: after few iterations hardly any comes to rest, and training may tame it.
    """
    noise, network = task.structure.noise != "none", task.structure.n_hidden > 0
    kinds = {(False, False): _linear, (False, True): _network, (True, False): _with_noise, (True, True): _bent}
    try:
        fitted = kinds[noise, network](problem, task)
    except ModelError as error:
        return str(error)
    swings = network and problem.settles and wild(fitted.model.plant, problem)
    fitted = replace(fitted, held_out=np.inf) if swings and task.last else replace(fitted, wild=swings)
    return _beside_what_is_known(problem, fitted)


def _beside_what_is_known(problem: Problem, fitted: Fitted) -> Fitted:
    """The fit without what is known not to act, and with what contradicts the rest; the fit where nothing is known."""
    if not problem.known.pairs:
        return fitted
    model = problem.known.quiet(fitted.model)
    return replace(fitted, model=model, against=problem.known.against(model.plant, problem.data))


def _linear(problem: Problem, task: FitTask) -> Fitted:
    s = task.structure
    train, held = problem.train(s, task.fold), problem.held(s, task.fold)
    if task.begun is not None:
        model, starts = task.begun.model, task.begun.starts
    elif s.start == "lagged":
        model, starts = _lagged(problem, s, task.fold), None
    else:
        if task.start is None:
            raise ModelError("the record shows no impulse response to start from")
        model = task.start.realizations.order(s.order)
        first = OutputErrorFit(iterations=3, correction=s.correction).fit(model, train, free=model.mask(b=True, c=True))
        model, starts = first.model, first.starts
    fitter = OutputErrorFit(iterations=task.iterations, correction=s.correction, judged=problem.judged)
    return fitter.fit(model, train, held, starts=starts)


def _lagged(problem: Problem, structure: Structure, fold: int) -> Dynamics:
    rows = problem.part(structure, problem.folds[fold].train)
    return problem.known.lagged(lagged_start(rows, *structure.lags), structure.lags[0])


def _network(problem: Problem, task: FitTask) -> Fitted:
    """A network, begun as its linear model with units that do nothing.

    A lagged start first trains one step ahead (correction 1, output rows only), then frees all rows. The free run of
    slow plants has poor minima: the fit begins twice, at once and by way of corrected runs, and the better one goes on.
    """
    s = task.structure
    train, held = problem.train(s, task.fold), problem.held(s, task.fold)
    fitter = OutputErrorFit(
        iterations=task.iterations, correction=s.correction, judged=problem.judged, ridge=s.ridge, patience=PATIENCE
    )
    if task.begun is not None:
        return fitter.fit(task.begun.model, train, held, starts=task.begun.starts)
    starts: Sequence[Array] | None = None
    if s.start == "lagged":
        linear = _lagged(problem, s, task.fold)
    else:
        if task.base is None:
            raise ModelError("the linear model of this network could not be fitted")
        linear, starts = task.base.model, task.base.starts
    states = visited(linear, train, 1.0 if starts is None else s.correction)
    inputs = np.concatenate([part.v for part in train])
    model = with_units(linear, states, inputs, s.n_hidden, 1000 * problem.seed + task.seed)
    work = 0
    if starts is None:
        one_step = OutputErrorFit(iterations=BEGIN, correction=1.0, ridge=s.ridge)
        first = one_step.fit(model, train, free=output_rows(model, problem.data.y.shape[1]))
        model, work = first.model, first.work
    eased = OutputErrorFit(iterations=BEGIN, correction=max(EASED, s.correction), ridge=s.ridge)
    plain = OutputErrorFit(iterations=BEGIN, correction=s.correction, ridge=s.ridge)
    by_way, at_once = eased.fit(model, train, starts=starts), plain.fit(model, train, starts=starts)
    after = plain.fit(by_way.model, train, starts=by_way.starts)
    begun = min((after, at_once), key=lambda fitted: fitted.trained)
    found = fitter.fit(begun.model, train, held, starts=begun.starts)
    return replace(found, work=work + by_way.work + at_once.work + after.work + found.work)


def _with_noise(problem: Problem, task: FitTask) -> Fitted:
    """A linear model with its noise: the impulse response of the ARX as it is, its filter fitted; or all refined.

    One-step errors say little of what a plant does slowly, and the prior of the ARX says it better than a fit that is
    free. So the refined model is another candidate, not a better one by itself.
    """
    s = task.structure
    train, held = problem.train(s, task.fold), problem.held(s, task.fold)
    if task.begun is not None and isinstance(task.begun.model, Innovations):
        return PredictionError(iterations=task.iterations).fit(task.begun.model, train, held)
    if task.start is None:
        raise ModelError("the record shows no impulse response to start from")
    plant = task.start.realizations.order(s.order)
    middle = np.concatenate([part.v for part in train]).mean(axis=0)
    model = begun(replace(plant, c=-plant.b @ middle), train)
    return PredictionError(iterations=task.iterations).fit(model, train, held, gain_alone=s.noise == "gain")


def _bent(problem: Problem, task: FitTask) -> Fitted:
    """A network with its noise, begun as its linear model with units that do nothing."""
    s = task.structure
    train, held = problem.train(s, task.fold), problem.held(s, task.fold)
    fitter = PredictionError(iterations=task.iterations, ridge=s.ridge, patience=PATIENCE)
    if task.begun is not None and isinstance(task.begun.model, Innovations):
        return fitter.fit(task.begun.model, train, held)
    base = None if task.base is None else task.base.model
    if not isinstance(base, Innovations):
        raise ModelError("the linear model of this network could not be fitted")
    n_y = problem.data.y.shape[1]
    states = visited(base, train, 0.0)[:, : base.plant.n_x]
    inputs = np.concatenate([part.v for part in train])
    units = with_units(base.plant, states, inputs, s.n_hidden, 1000 * problem.seed + task.seed)
    return fitter.fit(replace(with_loads(units, n_y), gain=base.gain), train, held)


def judged_beyond_drift(problem: Problem, rows: int, task: tuple[Structure, int, Fitted]) -> Fitted:
    """A fit whose held-out error leaves out a gain and a level of each ``rows`` rows; one that exploded stays so."""
    structure, fold, fitted = task
    if not np.isfinite(fitted.held_out):
        return fitted
    return replace(fitted, held_out=error_beyond_drift(fitted.model, problem.held(structure, fold), rows))


def on_all_rows(problem: Problem, structure: Structure, fitted: Fitted) -> Fitted:
    """The fit gone on over all rows, by fewer iterations where more end in a model that does not settle.

    The fit as it is where it would come to contradict what is known of the plant. A linear model that settles in its
    fold's rows is asked to settle too.
    """
    found = _beside_what_is_known(problem, _on_all_rows(problem, structure, fitted))
    return fitted if found.against - fitted.against else found


def _on_all_rows(problem: Problem, structure: Structure, fitted: Fitted) -> Fitted:
    whole = problem.whole(structure)
    if isinstance(fitted.model, Innovations):
        return _with_noise_on_all_rows(problem, structure, fitted, fitted.model)
    for iterations in (30, 8, 2):
        fitter = OutputErrorFit(iterations=iterations, correction=structure.correction, ridge=structure.ridge)
        found = fitter.fit(fitted.model, whole)
        if not problem.settles or _settles_too(problem, found.model, fitted.model):
            return found
    return fitted


def _settles_too(problem: Problem, found: Dynamics, begun: Dynamics) -> bool:
    """Whether a network settles, and a linear model if the one does that it was begun with."""
    if found.n_hidden:
        return not wild(found, problem)
    return slowest_pole(found) <= max(INTEGRATES, slowest_pole(begun))


def _with_noise_on_all_rows(problem: Problem, structure: Structure, fitted: Fitted, model: Innovations) -> Fitted:
    """A model with its noise over all rows; where only its filter is fitted, from the impulse response of all rows."""
    whole = problem.whole(structure)
    if structure.noise == "gain":
        try:
            rows = problem.part(structure, slice(None))
            response = problem.known.without(high_order_arx(rows).impulse_response(RESPONSE))
            plant = Realizations.of(response, problem.known.weights(rows.v.std(axis=0))).order(structure.order)
            model = begun(replace(plant, c=-plant.b @ rows.v.mean(axis=0)), whole)
        except ModelError:  # all rows together show no stable response, though a fold did
            return fitted
    if innovations(model, whole) is None:  # its fold's rows it followed
        return fitted
    for iterations in (15, 4):
        fitter = PredictionError(iterations=iterations, ridge=structure.ridge)
        found = fitter.fit(model, whole, gain_alone=structure.noise == "gain")
        if not problem.settles or _settles_too(problem, found.model.plant, fitted.model.plant):
            return found
    return fitted


def within_limits(problem: Problem, structure: Structure, fitted: Fitted) -> Fitted:
    """A linear fit with no pole outside the unit circle: those are put on it, and B and c fitted again.

    Others are returned as they are.
    """
    model = fitted.model
    if model.n_hidden or slowest_pole(model.plant) <= 1:
        return fitted
    if isinstance(model, Innovations):
        plant = model.plant
        a = model.a.copy()
        a[: plant.n_x, : plant.n_x] = within_unit_circle(plant.a, 1 - 1e-9)
        whole, inner = problem.whole(structure), replace(model, a=a)
        try:
            if innovations(inner, whole) is None:  # the gain was that of another plant
                inner = begun(inner.plant, whole)
            return PredictionError(iterations=5).fit(inner, whole, gain_alone=True)
        except ModelError:  # no filter follows: laws say what they think of such a plant
            return replace(fitted, model=inner)
    inside = replace(model, a=within_unit_circle(model.a, 1 - 1e-9))
    again = OutputErrorFit(iterations=5, correction=structure.correction)
    return again.fit(inside, problem.whole(structure), free=inside.mask(b=True, c=True))


# ---------------------------------------------------------------------- what a fit shows
def visited(model: Dynamics, train: list[Stretch], correction: float) -> Array:
    """States (N, n_x) of the run over all rows in the order of ``train``; ModelError where it explodes."""
    found = []
    for start, stretch in zip(fit_starts(model, train, correction), train, strict=True):
        run = model.free_run(start, stretch, correction)
        if run is None:
            raise ModelError("the linear start explodes over its own training rows; record more samples")
        found.append(run[1])
    return np.concatenate(found)


def wild(model: Dynamics, problem: Problem) -> bool:
    """Whether the model does not settle over the inputs of the data.

    An unusable one: an output goes beyond all bounds under one of them held constant, or swings under a tenth of them,
    or does not come back from states far outside the visited ones while the inputs change.
    """
    n_y, v = problem.data.y.shape[1], _held_inputs(problem)
    x, share = rests_under(model, problem)
    if not np.abs(x[:, :n_y]).max() < problem.farthest or share < RESTING_SHARE:
        return True
    middle = np.median(x, axis=0)
    x = middle + RETURN_DISTANCE * (x - middle)
    for shift in range(0, len(v), 7):
        x, _ = model.hold(x, np.roll(v, -shift, axis=0), 100)
    return not np.abs(x[:, :n_y]).max() < problem.farthest


def rests_under(model: Dynamics, problem: Problem) -> tuple[Array, float]:
    """(states (n, n_x) a long time after inputs of the data were held, the share of them that stand still)."""
    x, still = settle(model, _held_inputs(problem))
    return x, float(still.mean())


def _held_inputs(problem: Problem) -> Array:
    """Inputs (n, n_v) of the data, spread evenly over its rows."""
    v = problem.data.v
    return v[np.linspace(0, len(v) - 1, HELD_INPUTS).astype(np.int64)]


def misses(model: Dynamics, starts: list[Array], train: list[Stretch], ratio: float, correction: float) -> bool:
    """Whether the residual of an output exceeds ``ratio`` times its noise: drift, or dynamics that the model lacks."""
    found = residuals(model, starts, train, correction)
    if found is None:
        return True
    whole, fast = deviation_of(found), deviation_of(changes_of(found)) / np.sqrt(2)
    return bool(np.any(whole > ratio * fast))
