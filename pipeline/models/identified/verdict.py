"""The verdict on an identified model: its structure, its free run, gains and responses with bands, first answers."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from loopwright.pipeline.dynamics.step_response import ANSWER_PERIODS, STILL_CURVE, late_change, late_slope
from loopwright.pipeline.historian.settling import MOST_PERIODS
from loopwright.pipeline.metrics import fit_percent
from loopwright.pipeline.models.identified.dynamics import Dynamics, Stretch
from loopwright.pipeline.models.identified.identified import dead_periods, pair_answers, step_responses
from loopwright.pipeline.models.identified.innovations import PREDICTED_AHEAD, Innovations, ahead
from loopwright.pipeline.models.identified.output_error import fit_starts
from loopwright.pipeline.models.identified.parameter_uncertainty import spread
from loopwright.pipeline.models.identified.scaled_record import ScaledRecord, Scales
from loopwright.pipeline.models.identified.steady_states import (
    DIRECTION_PERIODS,
    INTEGRATES,
    central_map,
    middle_rest,
    settle,
    steady_gain,
)
from loopwright.pipeline.models.identified.structure import CandidateFits, Problem
from loopwright.pipeline.models.identified.structure_search import Selection
from loopwright.pipeline.models.identified.wandering_load import ErrorsAhead
from loopwright.pipeline.plants.simulator import Array
from loopwright.serving.manifest import Signal

GAIN_PLACES = (0.1, 0.3, 0.5, 0.7, 0.9)
"""Places of an input over its data at which the local gain is taken."""

SLOPE_PERIODS, BENT_GROWTH = 30, 1.2
"""Last periods of an answer, over which the slope of an integrator's is taken, and growth that bends it too far."""

SIGN_SDS = 2.0
"""Standard deviations from zero beyond which a gain's sign is certain."""

RESPONSE_POINTS = 60  # points kept of a step response, which is computed over twice as many samples or more
LONGEST_RESPONSE = 960
"""Points of a step response, and the most periods that it spans."""

STEP_SDS = 0.3
"""Size of a step, in standard deviations of the input in the data."""


def structure_figures(selection: Selection, unseen: Sequence[str] = ()) -> dict[str, Any]:
    """The chosen structure, the errors of both classes, and the verdict in words.

    ``unseen`` says what of the plant's curves the record cannot show, a clause each; it stands with the verdict.
    """
    chosen, network = selection.chosen, selection.network
    s = chosen.structure
    if network is None:
        words = "linear is enough: its residual is as small as the noise, or no network could be trained"
    elif selection.refused:
        words = "linear: a network was chosen first, but the record does not prove its gains, and proves these"
    elif network.against != selection.linear.against:
        words = (
            f"{'nonlinear' if selection.nonlinear else 'linear'}: the other kind contradicts what is known of the plant"
        )
    elif selection.innovations is not None and not selection.nonlinear:
        where = "in closed loop" if selection.ahead is None else "in which loads wander"
        words = (
            f"linear: one row ahead no network is better by enough to count; a record {where} often does not "
            "tell whether gains change over the range"
        )
    elif selection.nonlinear and selection.innovations is not None:
        words = f"nonlinear: one row ahead the network is better by {selection.innovations:.3g} nats over held-out rows"
    elif selection.nonlinear:
        words = f"nonlinear by a factor of {selection.factor:.3g} in the held-out free run"
    else:
        # Against chance a network must be better by more than its fits differ.
        factor = selection.factor
        how = f"{factor:.3g} times smaller only" if factor > 1 else f"{1 / factor:.3g} times as large"
        words = f"linear is enough: the held-out error of the best network is {how}"
    return {
        "start": s.start,
        "order": s.order,
        "lags": list(s.lags),
        "delays": list(s.delays),
        "hidden": s.n_hidden,
        "ridge": s.ridge,
        "correction": s.correction,
        "same_row": s.same_row,
        "drifts": selection.drifts,
        "noise": s.noise,
        "judged": _judged(selection),
        "ahead": None
        if selection.refused
        else _ahead_figures(selection.ahead, wanders=selection.innovations is not None),
        "rows_ahead": None if selection.innovations is None else PREDICTED_AHEAD,
        "row_convention": f"the MVs of a row act on the outputs of the {'same' if s.same_row else 'next'} row",
        "held_out_error": chosen.error,
        "held_out_spread": chosen.spread,
        "linear_error": selection.linear.error,
        "network_error": None if network is None else network.error,
        "network_spread": None if network is None else network.spread,
        "nonlinear_factor": selection.factor,
        "verdict": "; but ".join((words, *unseen[:1])) + "".join(f"; {more}" for more in unseen[1:]),
        "nominal_seconds": selection.spent,
    }


def _ahead_figures(found: ErrorsAhead | None, *, wanders: bool) -> dict[str, Any] | None:
    """Both errors, the rows that they look ahead, whether one-step errors chose; None where nothing was compared."""
    if found is None or not np.all(np.isfinite(found)):
        return None
    return {**found._asdict(), "rows": PREDICTED_AHEAD, "wanders": wanders}


def _judged(selection: Selection) -> str:
    if selection.innovations is not None:
        why = "the MVs follow the PVs" if selection.ahead is None else "loads wander in the record"
        return f"one-step errors with a model of the loads ({why})"
    return "free run" + (" beyond a gain and a level of each part of the record" if selection.drifts else "")


def free_run_figures(
    problem: Problem, trial: CandidateFits, scales: Scales, names: Sequence[str], fold: int = 0
) -> tuple[dict[str, dict[str, Any]], dict[str, Array]]:
    """(figures of each PV, {measured, free run} (n, n_y)) of a fold's best fit over the rows that it never saw.

    Runs of a model with its noise begin anew from its filter every ``PREDICTED_AHEAD`` rows: a run over all of them
    would hold the loads that nobody measured, and say nothing of the model. ``free_run_rmse`` and the PV's own
    deviation ``held_sd`` in its unit, ``fit_percent``, ``rmse_by_third``: where the PV was low, in the middle and high,
    and ``outside_training``: the share of these rows in which it left the range of the training rows, where the error
    says nothing of the other rows.
    """
    best, problem = trial.of_fold(fold)[0], problem.in_a_loop
    held = problem.held(trial.structure, fold)
    pairs = _ahead(best.model, held) if isinstance(best.model, Innovations) else _free(problem, best.model, held)
    actual, predicted = (np.concatenate(of) * scales.y_scale + scales.y_center for of in zip(*pairs, strict=True))
    trained = (
        np.concatenate([part.y for part in problem.train(trial.structure, fold)]) * scales.y_scale + scales.y_center
    )
    low, high = trained.min(axis=0), trained.max(axis=0)
    figures = {}
    for i, name in enumerate(names):
        read = np.isfinite(actual[:, i])
        y, foreseen = actual[read, i], predicted[read, i]
        error = y - foreseen
        edges = np.quantile(y, [1 / 3, 2 / 3])
        thirds = [error[np.searchsorted(edges, y) == j] for j in range(3)]
        figures[name] = {
            "free_run_rmse": float(np.sqrt(np.mean(error**2))),
            "held_sd": float(y.std()),
            "fit_percent": fit_percent(y, foreseen) if np.all(np.isfinite(error)) else None,
            "outside_training": float(np.mean((y < low[i]) | (y > high[i]))),
            "rmse_by_third": [float(np.sqrt(np.mean(e**2))) if len(e) else None for e in thirds],
        }
    return figures, {"measured": actual, "free run": predicted}


def _free(problem: Problem, model: Dynamics, held: Sequence[Stretch]) -> list[tuple[Array, Array]]:
    """(measured, NaN where nothing is read, free run) (n, n_y) of each stretch."""
    runs = zip(fit_starts(model, held, problem.judged), held, strict=True)
    found = [(s, model.free_run(x, s, problem.judged)) for x, s in runs]
    return [
        (s.errors(np.zeros_like(s.y)), np.full(s.y.shape, np.nan) if r is None else r[0][:, : s.y.shape[1]])
        for s, r in found
    ]


def _ahead(model: Innovations, held: Sequence[Stretch]) -> list[tuple[Array, Array]]:
    """(measured, predicted some rows ahead) (n, n_y) of each stretch."""
    return [ahead(model, s) for s in held]


# ---------------------------------------------------------------------- what the plant does
def rests_of(model: Dynamics, data: ScaledRecord) -> tuple[Array, Array]:
    """(states (n, n_x), inputs (n, n_v)) of rests: each input at its quantiles, the others at their medians."""
    middle = np.median(data.v, axis=0)
    places = [
        np.where(np.arange(len(middle)) == j, np.quantile(data.v[:, j], q), middle)
        for j in range(len(middle))
        for q in GAIN_PLACES
    ]
    v = np.array(places)
    start = np.column_stack([np.zeros((len(v), data.y.shape[1])), v, np.ones(len(v))]) @ central_map(model, data).T
    x, still = settle(model, v, start)
    return np.where(still[:, None], x, start), v


def gains(model: Dynamics, data: ScaledRecord) -> tuple[Array, NDArray[np.bool_], float]:
    """(local steady gains (n_v, quantiles, n_y), scaled; which of them are rates; the largest spectral radius there).

    For an integrating output the slope of the response to a step, a period, stands in place of the gain: a rate. It is
    taken over the last rows, of a pole beyond 1, which a record cannot tell from 1, before that bends it by
    ``BENT_GROWTH``.
    """
    n_y, n_v = data.y.shape[1], data.v.shape[1]
    x, v = rests_of(model, data)
    gain, radius = steady_gain(model, x, v)
    found, rates = np.empty((n_v, len(GAIN_PLACES), n_y)), np.zeros((n_v, len(GAIN_PLACES), n_y), dtype=np.bool_)
    for j in range(n_v):
        for q in range(len(GAIN_PLACES)):
            at = j * len(GAIN_PLACES) + q
            if radius[at] > INTEGRATES or not np.all(np.isfinite(gain[at])):
                response = (
                    step_responses(model, x[at], v[at], 1e-3 * np.ones(n_v), DIRECTION_PERIODS)[j, :, :n_y] / 1e-3
                )
                rates[j, q] = (
                    np.abs(late_change(response.T, SLOPE_PERIODS)) > 1e-3 * np.abs(response).max(axis=0) + 1e-9
                )
                end = (
                    int(
                        np.clip(
                            np.log(BENT_GROWTH) / np.log(max(radius[at], 1 + 1e-9)), MOST_PERIODS, DIRECTION_PERIODS
                        )
                    )
                    - 1
                )
                found[j, q] = np.where(rates[j, q], late_slope(response[: end + 1].T, SLOPE_PERIODS), response[-1])
            else:
                found[j, q] = gain[at, :n_y, j]
    return found, rates, float(radius.max())


def gain_figures(
    members: Sequence[Dynamics], data: ScaledRecord, scales: Scales, pvs: Sequence[Signal], inputs: Sequence[Signal]
) -> dict[str, Any]:
    """The steady gain [PV/input] of each PV and input, its spread over the members, its sign, its range over the data.

    ``gain`` is taken where all inputs are at the medians of the data; where ``rate`` is true it is in PV/input a
    period. ``sign`` is uncertain where the gain lies within ``SIGN_SDS`` spreads of zero; ``varies`` is the ratio of
    the largest to the smallest local gain, None where the gain changes its sign. Members that settle and members that
    do not have figures of two units: those count that are the more.
    """
    found = [gains(m, data) for m in members]
    local, rates = (np.array([of[k] for of in found]) for k in (0, 1))  # (members, n_v, quantiles, n_y)
    table: dict[str, Any] = {}
    for i, pv in enumerate(pvs):
        table[pv.name] = {}
        for j, signal in enumerate(inputs):
            unit = scales.y_scale[i] / scales.v_scale[j]
            moving = rates[:, j, len(GAIN_PLACES) // 2, i]
            rate = bool(2 * np.count_nonzero(moving) > len(members))
            of = local[moving == rate, j, :, i] * unit
            middle = of[:, len(GAIN_PLACES) // 2]
            gain, sd = float(np.median(middle)), spread(middle) if len(middle) > 1 else 0.0
            over = np.median(of, axis=0)
            turns = bool(over.min() < 0 < over.max())
            table[pv.name][signal.name] = {
                "gain": gain,
                "spread": sd,
                "rate": rate,
                "sign": "uncertain" if abs(gain) <= SIGN_SDS * sd else "+" if gain > 0 else "-",
                "low": float(over.min()),
                "high": float(over.max()),
                "varies": None if turns else float(np.abs(over).max() / max(np.abs(over).min(), 1e-12)),
            }
    return table


def response_curves(members: Sequence[Dynamics], data: ScaledRecord) -> Array:
    """Changes (members, n_v, length, n_y) of the outputs by a step of each input, scaled, until they settle.

    A step of input j is ``STEP_SDS`` times its standard deviation in the data, from the rest under the medians.
    """
    middle, size, n_y = np.median(data.v, axis=0), STEP_SDS * data.v.std(axis=0), data.y.shape[1]
    length, rests = 2 * RESPONSE_POINTS, [middle_rest(m, data) for m in members]
    while True:
        runs = [step_responses(m, x, middle, size, length)[..., :n_y] for m, x in zip(members, rests, strict=True)]
        found = np.array(runs)
        late = np.abs(late_change(np.moveaxis(found, 2, -1), length // 5 - 1)).max()
        if length >= LONGEST_RESPONSE or late < STILL_CURVE * np.abs(found).max():
            return found
        length *= 2


def response_figures(
    curves: Array,
    delays: Sequence[int],
    data: ScaledRecord,
    scales: Scales,
    pvs: Sequence[Signal],
    inputs: Sequence[Signal],
    late: Sequence[int] = (),
) -> dict[str, Any]:
    """Step responses of each PV to a unit step of each input, from ``response_curves`` (members, n_v, length, n_y).

    A response holds ``periods``, and over the members the ``middle``, ``low`` and ``high`` in PV/input.
    ``late`` (n_y,) are the periods by which the outputs come late.
    """
    size, length = STEP_SDS * data.v.std(axis=0), curves.shape[2]
    every, of_output = max(length // RESPONSE_POINTS, 1), tuple(late) or (0,) * len(pvs)
    table: dict[str, Any] = {pv.name: {} for pv in pvs}
    for j, signal in enumerate(inputs):
        for i, pv in enumerate(pvs):
            found = curves[:, j, ::every, i] * scales.y_scale[i] / (scales.v_scale[j] * size[j])
            table[pv.name][signal.name] = {
                "periods": [int(k) + 1 + int(delays[j]) + of_output[i] for k in range(0, length, every)],
                "middle": np.median(found, axis=0).tolist(),
                "low": found.min(axis=0).tolist(),
                "high": found.max(axis=0).tolist(),
            }
    return table


def answer_figures(
    model: Dynamics,
    delays: Sequence[int],
    data: ScaledRecord,
    pvs: Sequence[Signal],
    inputs: Sequence[Signal],
    lateness: Sequence[int] = (),
) -> dict[str, dict[str, Any]]:
    """``first_answers`` [periods] of each PV to each input, and ``dead_times`` [periods] of each input.

        k_ij = delay_j + late_i + k_ij(model),   theta_j = min_i k_ij - 1

    They are the finished model's own, and ``dead`` of ``Identified`` holds the same dead times: the report, the
    manifests of the controllers and so their monitors read these. A first answer is None where nothing moves.
    """
    answers = pair_answers(model, data) + np.asarray(lateness or (0,) * len(pvs))
    late = np.asarray(delays)
    first = [[int(k + late[j]) if k <= ANSWER_PERIODS else None for k in of] for j, of in enumerate(answers)]
    named = [signal.name for signal in inputs]
    return {
        "first_answers": {
            pv.name: {name: of[i] for name, of in zip(named, first, strict=True)} for i, pv in enumerate(pvs)
        },
        "dead_times": dict(zip(named, map(float, dead_periods(answers) + late), strict=True)),
    }
