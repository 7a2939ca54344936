"""The offset-free inverse laws: the observer, the inversion, and what must not happen in closed loop."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from shipped import required
from torch import Tensor

from loopwright.pipeline.errors import LawError
from loopwright.pipeline.laws.inverse.inverse_dob import ForwardDob, InverseDob, ObserverLaw, candidates
from loopwright.pipeline.models.base import Model
from loopwright.pipeline.plants.simulator import Signals
from loopwright.serving.manifest import Signal

PERIOD = 0.5
SIGNALS = Signals(
    PERIOD,
    sp=(Signal("y", "m", -10.0, 10.0),),
    pv=(Signal("y", "m", -10.0, 10.0), Signal("x", "m", -10.0, 10.0)),
    dv=(),
    mv=(Signal("u", "V", -1.0, 1.0),),
)
A, B = 0.8, 0.5  # x(k+1) = A x + B (u + d), y(k+1) = 0.7 y + x(k+1)
DVZ = torch.zeros(0, dtype=torch.float64)
NUMBERS = ObserverLaw.Params(**required("inverse_dob"))


def step_plant(y: float, x: float, u: float, d: float = 0.0) -> tuple[float, float]:
    x = A * x + B * (u + d)
    return 0.7 * y + x, x


class Exact(Model):
    """A stand-in for a network: the linear plant over h periods with the MV held."""

    kind = "exact"

    def __init__(self, horizon: int, output: int, sign: float = 1.0) -> None:
        super().__init__()
        m = np.array([[0.7, A, sign * B], [0.0, A, sign * B], [0.0, 0.0, 1.0]])
        row = np.linalg.matrix_power(m, horizon)[output]
        self.register_buffer("row", torch.from_numpy(row.copy()))

    def config(self) -> dict[str, object]:
        return {}

    def forward(self, x: Tensor) -> Tensor:
        return (x * self.row).sum(dim=-1, keepdim=True)


class ExactInverse(Model):
    kind = "exact_inverse"

    def __init__(self, forward: Exact) -> None:
        super().__init__()
        self.model = forward

    def config(self) -> dict[str, object]:
        return {}

    def forward(self, x: Tensor) -> Tensor:
        row = self.model.row
        return (x[..., 2:] - x[..., :1] * row[0] - x[..., 1:2] * row[1]) / row[2]


def make(kind: str, sign: float = 1.0, **params: float) -> ObserverLaw:
    forward, observer = Exact(2, 0, sign), Exact(1, 1, sign)
    settings_ = ObserverLaw.Params(**required("inverse_dob") | params)
    if kind == "inverse":
        return InverseDob(SIGNALS, ExactInverse(forward), forward, observer, settings_).eval()
    return ForwardDob(SIGNALS, forward, observer, settings_).eval()


def run(law: ObserverLaw, sp: np.ndarray, d: np.ndarray, sign: float = 1.0, applied: np.ndarray | None = None):
    """Closed loop; ``applied`` overrides the law's MV where finite (manual operation)."""
    y = x = 0.0
    mv = torch.zeros(1, dtype=torch.float64)
    state = torch.zeros(law.n_state, dtype=torch.float64)
    ys, us, infos = [], [], []
    for k in range(len(sp)):
        ys.append(y)
        pv = torch.tensor([y, x], dtype=torch.float64)
        with torch.no_grad():
            wanted, state, info = law(torch.tensor([sp[k]]), pv, DVZ, mv, state)
        mv = wanted if applied is None or not np.isfinite(applied[k]) else torch.tensor([applied[k]])
        us.append(float(wanted))
        infos.append(info.numpy())
        y, x = step_plant(y, x, sign * float(mv), d[k])
    return np.array(ys), np.array(us), np.array(infos)


@pytest.mark.parametrize("kind", ["inverse", "forward"])
def test_both_forms_invert_the_model(kind: str) -> None:
    """The MV held over the horizon leads the model to the request, where it can be reached."""
    law, model = make(kind), Exact(2, 0)
    state = torch.zeros(law.n_state, dtype=torch.float64)
    rng = np.random.default_rng(0)
    for y, x, u in zip(*rng.uniform(-0.9, 0.9, (3, 50)), strict=True):
        w = model(torch.tensor([y, x, u]))
        with torch.no_grad():
            mv, _, _ = law(w, torch.tensor([y, x]), DVZ, torch.zeros(1, dtype=torch.float64), state)
        assert float(mv) == pytest.approx(u, abs=1e-9)


@pytest.mark.parametrize("kind", ["inverse", "forward"])
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_matched_disturbance_is_estimated_and_leaves_no_offset(kind: str, sign: float) -> None:
    n = 800  # the small integral's mode is slow
    d = np.where(np.arange(n) < 400, 0.0, 0.3)
    ys, _, infos = run(make(kind, sign), np.full(n, 1.0), d, sign)
    assert abs(ys[399] - 1.0) < 1e-6
    assert np.abs(ys[-5:] - 1.0).max() < 1e-6
    assert infos[-1][3] == pytest.approx(sign * 0.3, abs=1e-6)


@pytest.mark.parametrize("kind", ["inverse", "forward"])
def test_the_observer_alone_is_offset_free(kind: str) -> None:
    ys, _, _ = run(make(kind, integral_gain=0.0), np.full(60, 1.0), np.full(60, -0.2))
    assert np.abs(ys[-5:] - 1.0).max() < 1e-6


@pytest.mark.parametrize("kind", ["inverse", "forward"])
def test_saturation_does_not_wind_up(kind: str) -> None:
    """After 600 samples at the limit the loop returns as after 60."""
    late = []
    for samples in (60, 600):
        sp = np.concatenate([np.full(samples, 100.0), np.full(30, 1.0)])
        ys, us, _ = run(make(kind), sp, np.zeros(len(sp)))
        assert us[samples - 1] == 1.0
        late.append(ys[samples:])
    assert np.abs(late[0][-1] - 1.0) < 2e-3
    assert np.abs(late[0] - late[1]).max() < 1e-4


@pytest.mark.parametrize("kind", ["inverse", "forward"])
def test_manual_operation_is_no_disturbance(kind: str) -> None:
    """The observer is fed the MV that the plant received, whatever the law had asked for; the integral waits."""
    applied = np.full(150, -0.5)
    y_manual = -0.5 * B / (1 - A) / (1 - 0.7)  # where that MV leads: the set point lies within the band of it
    _, _, infos = run(make(kind), np.full(150, y_manual + 0.02), np.zeros(150), applied=applied)
    assert np.abs(infos[:, 3]).max() < 1e-9
    # 100 samples of an error of 0.02 would wind it up to its limit, 0.03; the law may ask for -0.5 in passing.
    assert np.abs(infos[:, 4]).max() < 5e-4


@pytest.mark.parametrize("kind", ["inverse", "forward"])
def test_a_model_that_knows_nothing_pushes_the_right_way(kind: str) -> None:
    """Where the forward model's reach has the wrong sign (its own error), the MV still goes toward the set point."""

    class Flat(Exact):
        def forward(self, x: Tensor) -> Tensor:
            y = super().forward(x)
            cold = (x[..., :1] < -5).to(y.dtype)  # out there: no answer, and 1e-6 of it the wrong way
            return y * (1 - cold) + cold * (x[..., :1] - 1e-6 * x[..., 2:])

    forward, observer = Flat(2, 0), Exact(1, 1)
    if kind == "inverse":
        law: ObserverLaw = InverseDob(SIGNALS, ExactInverse(forward), forward, observer, NUMBERS)
    else:
        law = ForwardDob(SIGNALS, forward, observer, NUMBERS)
    state = torch.zeros(law.n_state, dtype=torch.float64)
    zero = torch.zeros(1, dtype=torch.float64)
    with torch.no_grad():
        mv, _, _ = law(torch.tensor([1.0], dtype=torch.float64), torch.tensor([-8.0, 0.0]).double(), DVZ, zero, state)
    assert float(mv) == 1.0


def test_candidates_of_any_model() -> None:
    model = Exact(1, 0)
    u = torch.tensor([-1.0, 0.0, 1.0], dtype=torch.float64)
    found = candidates(model, torch.tensor([0.5, 0.2], dtype=torch.float64), u)
    assert found.tolist() == pytest.approx([0.7 * 0.5 + A * 0.2 + B * v for v in u.tolist()])


def test_parameters_out_of_range_are_refused() -> None:
    with pytest.raises(ValueError, match=r"observer_gain is 1\.5"):
        ObserverLaw.Params(**required("inverse_dob") | {"observer_gain": 1.5})
    with pytest.raises(LawError, match="observed is 'z'; the process variables are y, x"):
        make("inverse", observed="z")  # type: ignore[arg-type]
