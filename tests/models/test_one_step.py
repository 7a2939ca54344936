"""The one-step comparison against plain loops and against cases in which a model must be right."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from loopwright.pipeline.cases.ph_neutralization.identification_example import example_record
from loopwright.pipeline.errors import ModelError, RecordError
from loopwright.pipeline.models.lagged.lagged import NNARX
from loopwright.pipeline.models.lagged.nnarx_part import VARIANCE, OneStep, compare_one_step
from loopwright.pipeline.models.training.regressors import nnarx_pairs
from loopwright.pipeline.records.record import Record


def a_record(n: int = 40, seed: int = 0) -> Record:
    rng = np.random.default_rng(seed)
    return example_record(rng.uniform(-1, 1, n), 0.1 * rng.standard_normal(n))


def a_model(record: Record, n_y: int = 2, n_u: int = 2, delay: int = 1) -> NNARX:
    pairs = nnarx_pairs(record, n_y, n_u, delay=delay)
    model = NNARX.scaled_to(pairs.x, pairs.y, n_y=n_y, n_u=n_u, delay=delay, hidden=(4,))
    model.net.reset(torch.Generator().manual_seed(1))
    return model.eval()


@pytest.mark.parametrize(("n_y", "n_u", "delay"), [(2, 2, 1), (1, 3, 1), (1, 1, 2)])
def test_each_prediction_uses_what_was_known_a_sample_before(n_y: int, n_u: int, delay: int) -> None:
    """Against a loop over samples with autograd and with the weighted least squares solved anew at each."""
    record = a_record()
    model = a_model(record, n_y, n_u, delay)
    found = compare_one_step(model, record, forgetting=(0.8,), scaled=False)
    y, u = record.pv[:, 0], record.mv[:, 0]

    def phi(t: int) -> torch.Tensor:
        lags = [y[t - i] for i in range(1, n_y + 1)] + [u[t - delay - i] for i in range(n_u)]
        return torch.tensor(lags, dtype=torch.float64, requires_grad=True)

    first = max(n_y, n_u + delay - 1)
    assert list(found.time_s) == [float(t) for t in range(first + 1, len(y))]
    assert found.measured == pytest.approx(y[first + 1 :])
    for i, t in enumerate(range(first + 1, len(y))):
        before = phi(t - 1)
        value = model(before)
        (slope,) = torch.autograd.grad(value.sum(), before)
        with torch.no_grad():
            assert found.predicted["nnarx"][i] == pytest.approx(float(model(phi(t))), abs=1e-12)
            tangent = value[0] + slope @ (phi(t) - before)
        assert found.predicted["linearized"][i] == pytest.approx(float(tangent), abs=1e-12)
        known = range(first, t)
        design = np.array([[*phi(k).tolist(), 1.0] for k in known])
        weight = 0.8 ** np.arange(len(known) - 1, -1, -1)
        normal = (design.T * weight) @ design + 0.8 ** len(known) / VARIANCE * np.eye(design.shape[1])
        theta = np.linalg.solve(normal, (design.T * weight) @ y[list(known)])
        assert found.predicted["recursive_0.8"][i] == pytest.approx(theta @ [*phi(t).tolist(), 1.0], abs=1e-8)


def test_a_linear_network_is_its_own_linearization() -> None:
    record = a_record()
    model = a_model(record)
    with torch.no_grad():  # so little of tanh's range that it is straight to rounding
        for weight, bias in zip(model.net.weights[:-1], model.net.biases[:-1], strict=True):
            weight *= 1e-9
            bias.zero_()
        model.net.weights[-1] *= 1e9
    found = compare_one_step(model, record).predicted
    assert found["linearized"] == pytest.approx(found["nnarx"], abs=1e-9)
    assert np.ptp(found["nnarx"]) > 0.1


def test_a_recursive_model_learns_a_linear_plant_whatever_its_units() -> None:
    """Scaled as the network: flows of hundreds are learnt as fast as fractions are."""
    rng = np.random.default_rng(0)
    u = rng.uniform(-1, 1, 60)
    y = np.zeros(60)
    for k in range(59):
        y[k + 1] = 0.6 * y[k] + u[k]
    record = example_record(u)
    errors = []
    for unit in (1.0, 1e4):
        other = Record(
            1.0,
            record.pv_signals,
            record.mv_signals,
            (),
            record.run,
            record.time_s,
            y[:, None],
            unit * u[:, None] + unit,
            record.dv,
        )
        found = compare_one_step(a_model(other, 1, 1), other, forgetting=(0.8,))
        errors.append(np.abs(found.predicted["recursive_0.8"] - found.measured))
    assert errors[1] == pytest.approx(errors[0], abs=1e-9)
    assert errors[0][20:].max() < 1e-3


def test_other_lags_of_the_recursive_models_leave_the_samples_that_all_predict() -> None:
    record = a_record()
    found = compare_one_step(a_model(record, 1, 1), record, n_y=4, n_u=1)
    assert found.time_s[0] == 4.0
    assert {len(p) for p in found.predicted.values()} == {len(found.time_s)} == {len(record) - 4}
    assert list(found.predicted) == ["nnarx", "linearized", "recursive_0.8", "recursive_0.5"]
    assert set(found.curves()) == {"time_s", "measured", *found.predicted}


def test_sse_is_the_sum_of_squares() -> None:
    trial = OneStep(np.arange(2.0), np.array([1.0, 2.0]), {"a": np.array([1.5, 0.0])})
    assert trial.sse() == {"a": 4.25}


def test_several_runs_and_short_ones_are_one_clear_line() -> None:
    record = a_record()
    model = a_model(record)
    runs = replace(record, run=(np.arange(len(record)) > 5).astype(np.int64))
    with pytest.raises(ModelError, match="this record holds several"):
        compare_one_step(model, runs)
    with pytest.raises(RecordError, match="too short for the lags"):
        compare_one_step(model, a_record(2))
