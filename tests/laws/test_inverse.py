"""The inverse laws, with an exact inverse and with networks."""

from __future__ import annotations

from typing import Any, ClassVar

import numpy as np
import pytest
import torch
from shipped import required
from torch import Tensor

from loopwright.pipeline.errors import LawError
from loopwright.pipeline.laws.inverse.inverse import INC, INCAD, INCADEC
from loopwright.pipeline.models import Model
from loopwright.pipeline.models.static.leverage_domain import LeverageDomain
from loopwright.pipeline.plants.simulator import Signals

DV = torch.zeros(0, dtype=torch.float64)
A, B, MIDDLE = 0.8, -1e-3, 250.0  # y(k+1) = A y(k) + B (mv(k) - MIDDLE) + disturbance; the second PV takes no part


def tensor(*values: float) -> Tensor:
    return torch.tensor(values, dtype=torch.float64)


class ExactInverse(Model):
    """mv = MIDDLE + (w - A y)/B: the inverse of a first-order plant without its disturbance."""

    kind: ClassVar[str] = "exact_inverse"

    def config(self) -> dict[str, Any]:
        return {}

    def forward(self, x: Tensor) -> Tensor:
        return MIDDLE + (x[..., 2:] - A * x[..., :1]) / B


@pytest.fixture(scope="module")
def exact() -> dict[str, Model]:
    """The exact inverse, and the domain of random moves of the same plant."""
    rng = np.random.default_rng(0)
    y, rows = 0.0, []
    for _ in range(3000):
        then = A * y + B * (rng.uniform(0, 500) - MIDDLE)
        rows.append((y, 300 + rng.normal(), then))
        y = then
    return {"inverse": ExactInverse(), "domain": LeverageDomain.fit(np.array(rows))}


def run(law, disturbance: float, sp: float, n: int = 60) -> tuple[np.ndarray, np.ndarray]:
    """Outputs and MVs of the loop over the plant from rest at 0, with a disturbance that the inverse does not know."""
    state, mv = torch.zeros(law.n_state, dtype=torch.float64), tensor(250.0)
    y, ys, mvs = 0.0, [], []
    for _ in range(n):
        mv, state, _ = law(tensor(sp), tensor(y, 300.0), DV, mv, state)
        ys.append(y)
        mvs.append(mv.item())
        y = A * y + B * (mv.item() - MIDDLE) + disturbance
    return np.array(ys), np.array(mvs)


def design(cls, parts, signals: Signals, plant, **params: Any):
    return cls.design(cls.Params(**(required(cls.name) | params)), parts, signals, plant)


def test_inc_is_the_network_and_its_limits(parts, signals, plant) -> None:
    law = design(INC, parts, signals, plant)
    pv, sp = tensor(0.5, 320.0), tensor(0.51)
    mv, _, info = law(sp, pv, DV, tensor(0.0), tensor())
    asked = parts["inverse"](torch.cat([pv, sp]))
    assert info.item() == asked.item()
    assert mv.item() == asked.clamp(0.0, 500.0).item()


def test_inc_with_an_exact_inverse_is_dead_beat(exact, signals, plant) -> None:
    ys, _ = run(design(INC, exact, signals, plant), 0.0, -0.2)
    np.testing.assert_allclose(ys[1:], -0.2, atol=1e-12)


def test_incad_requests_no_more_than_the_domain_holds(parts, signals, plant) -> None:
    law = design(INCAD, parts, signals, plant, r=1.0)
    rng = np.random.default_rng(1)
    cvs, xs, _ = plant.steady_curve
    pv = torch.from_numpy(xs[rng.integers(0, len(cvs), 300)])
    sp = torch.from_numpy(rng.uniform(0, 1, (300, 1)))
    _, _, info = law(sp, pv, torch.zeros(300, 0, dtype=torch.float64), sp, torch.zeros(300, 0, dtype=torch.float64))
    got = dict(zip(law.info, info.unbind(-1), strict=True))
    w, h = got["sp_requested"], got["leverage"]
    domain = parts["domain"]
    torch.testing.assert_close(h, domain(torch.cat([pv, w[:, None]], dim=-1))[:, 0])
    inside = domain.interval(pv).room[:, 0] > 0
    assert inside.any()
    assert (h[inside] <= domain.threshold * (1 + 1e-9)).all()
    assert (got["in_domain"] == inside.double()).all()
    # Outside, the request is to stay; inside, the nearest the bounds allow to the set point.
    torch.testing.assert_close(w[~inside], pv[~inside, 0], rtol=0, atol=0)
    free = inside & (sp[:, 0] > got["sp_min"]) & (sp[:, 0] < got["sp_max"])
    assert torch.equal(w[free], sp[free, 0])
    assert ((w == got["sp_min"]) | (w == got["sp_max"]) | free).all()


def test_more_narrowing_is_slower(exact, signals, plant) -> None:
    times = []
    for r in (1.0, 2.0, 4.0):
        ys, _ = run(design(INCAD, exact, signals, plant, r=r), 0.0, -0.45)
        times.append(int(np.argmax(np.abs(ys + 0.45) < 0.01)))
    assert times == sorted(times)
    assert times[0] < times[-1]


def test_incadec_as_printed_follows_equations_21_to_23(parts, signals, plant) -> None:
    incad = design(INCAD, parts, signals, plant, r=5.5)
    law = design(INCADEC, parts, signals, plant, r=5.5, correction="as_printed")
    rng = np.random.default_rng(2)
    state, w_ec = torch.zeros(2, dtype=torch.float64), None
    for _ in range(10):
        pv, sp = tensor(rng.uniform(0.05, 0.1), rng.uniform(365, 385)), tensor(rng.uniform(0.05, 0.1))
        mv, state, info = law(sp, pv, DV, tensor(250.0), state)
        w_re = incad(sp, pv, DV, tensor(250.0), tensor())[2][0]
        e = 0.0 if w_ec is None else w_ec - pv[0]
        w_ec = w_re + e
        assert info[0].item() == pytest.approx(w_ec.item(), rel=1e-12)
        assert info[law.info.index("error_correction")].item() == pytest.approx(float(e), abs=1e-15)
        asked = parts["inverse"](torch.cat([pv, w_ec[None]]))
        assert mv.item() == pytest.approx(asked.clamp(0, 500).item(), rel=1e-9)


@pytest.mark.parametrize("correction", ["as_printed", "back_calculation"])
def test_error_correction_leaves_no_offset(exact, signals, plant, correction: str) -> None:
    """A constant disturbance is the constant model error that eqs 21 and 22 assume."""
    plain, _ = run(design(INCAD, exact, signals, plant, r=3.0), -0.02, -0.3, 200)
    ys, mvs = run(design(INCADEC, exact, signals, plant, r=3.0, correction=correction), -0.02, -0.3, 200)
    assert abs(plain[-1] + 0.3) > 0.015
    assert abs(ys[-1] + 0.3) < 1e-6
    assert 0 < mvs[-1] < 500


def test_back_calculation_does_not_wind_up(exact, signals, plant) -> None:
    """A set point that a disturbance puts out of the actuator's reach for long, then one within it."""
    delays = {}
    for correction in ("as_printed", "back_calculation"):
        law = design(INCADEC, exact, signals, plant, r=3.0, correction=correction)
        state, mv, y, course = torch.zeros(law.n_state, dtype=torch.float64), tensor(250.0), 0.0, []
        for k in range(500):
            sp = 0.5 if k < 300 else 0.1
            mv, state, _ = law(tensor(sp), tensor(y, 300.0), DV, mv, state)
            y = A * y + B * (mv.item() - MIDDLE) - 0.2
            course.append(abs(y - 0.1))
        assert course[299] == pytest.approx(0.15, abs=1e-6)  # the MV at its limit
        delays[correction] = next((k for k, error in enumerate(course[300:]) if error < 0.01), len(course[300:]))
    assert delays["back_calculation"] < 12
    assert delays["as_printed"] > 10 * delays["back_calculation"]


def test_back_calculation_equals_the_printed_law_within_limits(exact, signals, plant) -> None:
    """Nothing is calculated back while the actuator gives what was asked."""
    runs = [
        run(design(INCADEC, exact, signals, plant, r=3.0, correction=c), -0.02, -0.1, 80)
        for c in ("as_printed", "back_calculation")
    ]
    assert all(0 < mv < 500 for mv in runs[0][1])
    np.testing.assert_allclose(runs[1][0], runs[0][0], rtol=1e-10)


def test_back_calculation_is_exact_for_a_straight_inverse(exact, signals, plant) -> None:
    """On a chord the w' of an applied MV is its own one-step prediction, in manual too."""
    law = design(INCADEC, exact, signals, plant, r=1.0, correction="back_calculation")
    y, sp = -0.28, tensor(0.5)
    _, state, info = law(sp, tensor(y, 300.0), DV, tensor(250.0), torch.zeros(5, dtype=torch.float64))
    asked, anchor = info[-1].item(), state[3].item()
    applied = 0.5 * (asked + MIDDLE + (anchor - A * y) / B)
    _, _, then = law(sp, tensor(-0.31, 300.0), DV, tensor(applied), state)
    assert then[law.info.index("error_correction")].item() == pytest.approx(
        A * y + B * (applied - MIDDLE) + 0.31, rel=1e-9
    )


@pytest.mark.parametrize("r", [0.99, 0.0, float("inf"), float("nan")])
def test_wrong_narrowing_is_named(parts, signals, plant, r: float) -> None:
    for cls in (INCAD, INCADEC):
        with pytest.raises(LawError, match="r is"):
            design(cls, parts, signals, plant, r=r)


def test_wrong_parts_are_named(parts, signals, plant) -> None:
    with pytest.raises(LawError, match="correction is 'none'"):
        design(INCADEC, parts, signals, plant, correction="none")
    with pytest.raises(LawError, match="kind leverage_domain; got rbf"):
        design(INCAD, {**parts, "domain": parts["inverse"]}, signals, plant)
    with pytest.raises(LawError, match="takes other inputs"):
        design(INC, {"inverse": LeverageDomain.fit(np.random.default_rng(0).normal(size=(20, 2)))}, signals, plant)
