"""State-space network: free run against a plain loop, sensitivities against autograd, and how it is learnt."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor
from torch.func import functional_call

from loopwright.pipeline.cases.reversible_cstr.plant import ReversibleCstr
from loopwright.pipeline.cases.thiosulfate_cstr.plant import ThiosulfateCstr
from loopwright.pipeline.errors import ModelError, ParamsError, RecordError
from loopwright.pipeline.excitation import EXCITATIONS
from loopwright.pipeline.models import load_model
from loopwright.pipeline.models.base import simulate
from loopwright.pipeline.models.lagged.nnarx_part import NnarxPart
from loopwright.pipeline.models.part import Source
from loopwright.pipeline.models.state_space import StateSpace, StateSpacePart, StateWindows, one_step_pairs
from loopwright.pipeline.models.training.objectives import Samples
from loopwright.pipeline.records.record import Record
from loopwright.serving.manifest import Signal


def made_up_record(runs: tuple[int, ...] = (30, 25), n_mv: int = 2, seed: int = 0) -> Record:
    """A linear plant of two states, its runs of different lengths."""
    rng = np.random.default_rng(seed)
    run = np.repeat(np.arange(len(runs)), runs)
    mv = rng.uniform(-1, 1, (len(run), n_mv))
    x = rng.normal(size=(len(run), 2))
    for k in range(1, len(run)):
        if run[k] == run[k - 1]:
            x[k] = x[k - 1] @ np.array([[0.9, 0.1], [-0.2, 0.7]]) + 0.1 * mv[k - 1].sum()
    pvs = tuple(Signal(f"y{i}", "1", -5.0, 5.0) for i in range(2))
    mvs = tuple(Signal(f"u{i}", "1", -2.0, 2.0) for i in range(n_mv))
    time_s = np.concatenate([np.arange(m, dtype=float) for m in runs])
    return Record(1.0, pvs, mvs, (), run, time_s, x, mv, np.zeros((len(run), 0)))


def model_for(record: Record, hidden: tuple[int, ...] = (5,), seed: int = 0) -> StateSpace:
    model = StateSpace.scaled_to(*one_step_pairs(record), hidden=hidden)
    model.net.reset(torch.Generator().manual_seed(seed))
    return model.eval()


def test_free_run_equals_a_plain_loop() -> None:
    record = made_up_record()
    model = model_for(record)
    cut = StateWindows.of(record, 6)
    with torch.no_grad():
        free = simulate(model, torch.from_numpy(cut.start), torch.from_numpy(cut.mv)).numpy()
        for i in (0, 7, len(cut) - 1):
            x = cut.start[i]
            for step in range(6):
                x = model(torch.from_numpy(np.concatenate([x, cut.mv[i, step]]))).numpy()
                assert free[i, step] == pytest.approx(x, rel=1e-12)


def test_windows_hold_what_the_record_holds_and_stay_within_its_runs() -> None:
    record = made_up_record((10, 7))
    cut = StateWindows.of(record, 4)
    assert len(cut) == 6 + 3
    assert np.array_equal(cut.start[6], record.pv[10])
    assert np.array_equal(cut.mv[6], record.mv[10:14])
    assert np.array_equal(cut.future[6], record.pv[11:15])
    assert len(StateWindows.of(record, 4, every=4)) == 3
    with pytest.raises(RecordError, match="too short"):
        StateWindows.of(record, 10)


def test_one_step_windows_cost_what_samples_cost() -> None:
    record = made_up_record()
    model, x_y = model_for(record), one_step_pairs(record)
    windows, samples = StateWindows.of(record, 1), Samples(*x_y)
    with torch.no_grad():
        assert float(windows.loss(model.net)) == pytest.approx(float(samples.loss(model.net)), rel=1e-12)


@pytest.mark.parametrize("steps", [1, 2, 7])
@pytest.mark.parametrize("hidden", [(4,), (3, 4)])
def test_normal_equations_against_autograd(steps: int, hidden: tuple[int, ...]) -> None:
    record = made_up_record()
    net = model_for(record, hidden).net
    cut = StateWindows.of(record, steps, every=3)
    names = [name for name, _ in net.named_parameters()]
    start, mv, future = (torch.from_numpy(a) for a in (cut.start, cut.mv, cut.future))

    def residuals(*values: Tensor) -> Tensor:
        x, found = start, []
        for step in range(steps):
            inputs = torch.cat([x, mv[:, step]], dim=1)
            x = functional_call(net, dict(zip(names, values, strict=True)), (inputs,))
            found.append((x - future[:, step]) / net.y_scale)
        return torch.cat(found).flatten() / cut.future.size**0.5

    values = tuple(p.detach() for p in net.parameters())
    blocks = torch.autograd.functional.jacobian(residuals, values)
    jac = torch.cat([b.flatten(1) for b in blocks], dim=1)
    r = residuals(*values)
    for chunk in (3, 1000):
        loss, gradient, hessian = cut.normal_equations(net, chunk)
        assert float(loss) == pytest.approx(float(r @ r), rel=1e-12)
        assert float(loss) == pytest.approx(float(cut.loss(net).detach()), rel=1e-12)
        assert torch.allclose(gradient, jac.T @ r, rtol=1e-9, atol=1e-12)
        assert torch.allclose(hessian, jac.T @ jac, rtol=1e-9, atol=1e-12)


def test_stored_model_is_the_model(tmp_path: Path) -> None:
    record = made_up_record()
    model, (x, _) = model_for(record), one_step_pairs(record)
    model.save(tmp_path / "model.npz")
    again = load_model(tmp_path / "model.npz")
    assert isinstance(again, StateSpace)
    with torch.no_grad():
        assert torch.equal(again(torch.from_numpy(x)), model(torch.from_numpy(x)))


def test_windows_that_do_not_match_are_refused() -> None:
    good = StateWindows.of(made_up_record(), 3)
    for bad in (
        (good.start[:, :1], good.mv, good.future),
        (good.start, good.mv[:, :2], good.future),
        (good.start[:0], good.mv[:0], good.future[:0]),
    ):
        with pytest.raises(ModelError, match="windows have shapes"):
            StateWindows(*bad)
    with pytest.raises(ModelError, match="not finite"):
        StateWindows(good.start * np.nan, good.mv, good.future)
    with pytest.raises(ModelError, match="at least 1"):
        StateSpace(0)


def test_part_needs_a_record_and_steps() -> None:
    with pytest.raises(ModelError, match="learns from a record"):
        StateSpacePart().learn(Source(None, ReversibleCstr().signals))
    with pytest.raises(ValueError, match="steps is 0"):
        StateSpacePart(steps=0)


@pytest.fixture(scope="module")
def reactor_record() -> Record:
    return EXCITATIONS["aprbs"](samples=3000, hold=5, spacing="log").run(ReversibleCstr(), 3)


def test_the_reactor_is_learnt_to_within_a_percent_of_a_long_free_run(reactor_record: Record) -> None:
    part = StateSpacePart(hidden=(10,), steps=30, long_run=400, trainer={"kind": "lm", "iterations": 40, "rows": 1500})
    learnt = part.learn(Source(reactor_record, ReversibleCstr().signals, regions={"all": (-np.inf, np.inf)}))
    figures = learnt.metrics["state_space"]
    assert set(figures) == {"one_step_trained", "free_run_trained"}
    for name in ("C_B", "T"):
        assert figures["free_run_trained"][name]["free_run_fit"] > 99.0
    assert learnt.metrics["free_run_rmse"] == figures["free_run_trained"]["C_B"]["free_run_rmse"]


def test_training_on_free_runs_mends_what_one_step_hides(reactor_record: Record) -> None:
    part = NnarxPart(
        hidden=(10,), steps=50, long_run=400, compared=0, trainer={"kind": "lm", "iterations": 40, "rows": 1500}
    )
    learnt = part.learn(Source(reactor_record, ReversibleCstr().signals))
    first, then = (learnt.metrics["nnarx"][name]["C_B"] for name in ("one_step_trained", "free_run_trained"))
    assert first["one_step_rmse"] < 1e-3 * np.ptp(reactor_record.pv[:, 0])  # accurate, one step ahead
    assert first["free_run_rmse"] > 10 * first["one_step_rmse"]  # and far off, running free
    assert then["free_run_fit"] > first["free_run_fit"]
    assert learnt.predictions is not None
    assert set(learnt.predictions) == {"time_s", "measured", "one_step_trained", "free_run_trained"}
    assert all(len(curve) == 400 for curve in learnt.predictions.values())


def test_levels_even_over_the_logarithm(reactor_record: Record) -> None:
    feed = reactor_record.mv[:, 0]
    assert feed.min() >= 1 / 3
    assert feed.max() <= 6.0
    assert 0.35 < np.mean(feed < 2**0.5) < 0.65  # the middle of the range by its logarithm


def test_a_range_from_zero_has_no_logarithm() -> None:
    with pytest.raises(ParamsError, match="no logarithm"):
        EXCITATIONS["aprbs"](samples=10, low=0.0, spacing="log").run(ThiosulfateCstr(), 0)
