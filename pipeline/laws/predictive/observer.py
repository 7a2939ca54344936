"""Extended Kalman filter over an identified model, with as many loads as outputs."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor, nn

from loopwright.pipeline.laws.base import hold_numbers
from loopwright.pipeline.laws.predictive.disturbance_model import Loads
from loopwright.pipeline.laws.predictive.horizon import one_step, product
from loopwright.pipeline.models.identified.identified import Identified
from loopwright.pipeline.models.memory import AffineMap

NOISE_FLOOR = (
    1e-2  # scaled; a model that claims less noise would believe rounding, and lose the digits of its covariance
)
LOAD_CHANGE = 3e-5  # scaled
FIRST_LOAD = 0.05  # scaled, a period: standard deviation of a load before anything was seen of it
INNOVATION_FORGETTING = 0.5  # of the mean innovation
CALMING = 0.1  # share of the last innovation in the mean squares
OUTLIER = 10.0  # largest innovation that counts, in the mean and in the squares: one alone would outgrow the other
RISE = 7.0  # times its variance in pure noise: the square of the mean innovation at which the boost begins
FULL = 4.0  # further such rises until it is full
SWING_WEIGHT = 4.0  # weight of innovations of both signs beyond those of noise
BOOST = 1_000.0  # times its normal variance a load may move in a period then


@dataclass(frozen=True, slots=True)
class Noises:
    """Variances of the filter, in units of the measurement's: of the outputs' model errors, and of the loads."""

    outputs: float
    loads: Tensor | float  # (n_y,), as each output sees it, or one for all
    jumps: float = 1.0  # share of BOOST that a load moves by then
    changes: Tensor | None = None  # (n_d,) scaled, of the loads beside those: as the record's changed


def load_variance(model: Identified) -> Tensor:
    """Variance (n_y,) of a load's change a period, in units of the noise's, where nothing is known of the loads.

    It is 3e-5 over the noise: a load as quick for every plant is 1/noise^2 of it, and one whose estimate moves the MV
    as calmly for every noise is the same share of it; this is their geometric mean.
    """
    return LOAD_CHANGE / torch.clamp(model.noise, min=NOISE_FLOOR)


class StateEstimate(NamedTuple):
    """The state and the loads, their covariance, and the mean innovation."""

    mean: Tensor  # (..., 1, n_x + n_d) [x, d]
    covariance: Tensor  # (..., n_x + n_d, n_x + n_d)
    drift: Tensor  # (..., 1, n_y) innovations in units of their standard deviation, averaged
    squares: Tensor  # (..., 1, 2 n_y) their squares, averaged for longer, without and with their signs


class Observer(nn.Module):
    """State x and loads d of an identified model f, scaled.

        x+ = f(x, v + V d) + X d + w,   d+ = d + n,   y = x[:n_y] + e

    w has the variance q_x R in the rows of the outputs, e has R, the square of the model's noise, and n has q_d
    R, R of the outputs that a load moves, and beside it the variance of the loads' changes in the record, where the
    law takes its loads from there. A load passes the plant's poles, unlike an error that is added to the output,
    and a load at an MV all its lags and dead times. The filter is the extended Kalman filter, whose correction takes
    the outputs one after another.

    A load that steps would be followed slowly. So the innovations e, by their standard deviation s and within -10..10,
    have a mean, and their squares two, without and with their signs:

        m <- m + a (e/s - m),   p <- p + c (e^2/s^2 - p),   q <- q + c (sign(e) e^2/s^2 - q)
        b = clip(m^2 (2 - a)/(7 a max(1 + 4 (p - |q| - 1), 1)) - 1, 0, 4)/4

    m^2 (2 - a)/a is 1 on average in pure noise, and the filter stays quiet. After a step of a load, the covariance of
    [x, d] grows by 1000 j b q_d R g g', where j is the share ``jumps``, and g is what a unit of the load has made of
    them by the time that the outputs show it (``Loads.begun``): state and load then follow together. Innovations of
    both signs, p - |q|, are no load but an error of the model: a loop that swings would be kept swinging by a filter
    that follows it.

    Source: the extended Kalman filter of Jazwinski, Stochastic Processes and Filtering Theory, section 8.3; loads
    as integrated noise after Pannocchia and Rawlings, AIChE Journal 49 (2003) 426; a jump of the state and the load
    together after Willsky and Jones, IEEE Transactions on Automatic Control 21 (1976) 108.
    """

    place: Tensor  # (n_y, n_a n_a) from a boost to what it adds to the covariance
    first: Tensor  # (n_a, n_a) covariance without a past
    q: Tensor  # (n_a, n_a)
    q_load: Tensor  # (n_a, n_a) of it, that of the loads
    r: Tensor  # (n_y,)
    f: Tensor  # (n_a, n_a) slope of [x, d] without tanh units
    f_t: Tensor
    w1: Tensor  # (n_h, n_a)
    w1_t: Tensor
    w2: Tensor  # (n_a, n_h)
    w2_t: Tensor
    forgetting: Tensor  # (1,) a
    rise: Tensor  # (1,) (2 - a)/(7 a)
    fall: Tensor  # (1,) 1/4
    calming: Tensor  # (1,) c
    swings: Tensor  # (1,) 4
    diagonal: Tensor  # (n_y,) where the outputs' variances stand in the flat covariance

    @torch.no_grad()
    def __init__(self, model: Identified, loads: Loads, noises: Noises) -> None:
        super().__init__()
        self.n_y, self.n_x, n_x = model.n_y, model.n_x, model.n_x
        self.n_a = n_a = n_x + loads.count
        self.layout = {"x": n_x, "d": loads.count, "v": model.n_mv + model.n_dv}
        self.step = AffineMap(self.layout, lambda p: _with_loads(one_step(model, loads, p), p["d"]))
        self.nonlinear = model.n_hidden > 0
        f = torch.eye(n_a, dtype=torch.float64)
        f[:n_x, :n_x], f[:n_x, n_x:] = model.a, loads.into_x + model.b @ loads.into_v
        w1, w2 = torch.zeros(model.n_hidden, n_a).double(), torch.zeros(n_a, model.n_hidden).double()
        w1[:, :n_x], w1[:, n_x:], w2[:n_x] = model.w1[:, :n_x], model.w1[:, n_x:] @ loads.into_v, model.w2
        # Both orders of each matrix: a product with a transposed one is not exported.
        for name, matrix in {"f": f, "w1": w1, "w2": w2}.items():
            self.register_buffer(name, matrix)
            self.register_buffer(f"{name}_t", matrix.T.contiguous())
        r = torch.clamp(model.noise, min=NOISE_FLOOR) ** 2
        q = torch.zeros(n_a, dtype=torch.float64)
        q[: self.n_y], q[n_x:] = noises.outputs * r, (noises.loads * r) @ loads.share
        if noises.changes is not None:
            q[n_x:] += noises.changes
        q_load = torch.cat([torch.zeros(n_x, dtype=torch.float64), q[n_x:]])
        place = torch.zeros(self.n_y, n_a, n_a, dtype=torch.float64)
        for i in range(loads.count):
            since = torch.cat(
                [loads.begun[..., i], torch.eye(loads.count, dtype=torch.float64)[i].expand(len(loads.begun), -1)],
                dim=-1,
            )
            grown = since.T @ since / len(since)  # (n_a, n_a)
            place += noises.jumps * BOOST / FULL * (noises.loads * r * loads.share[:, i])[:, None, None] * grown
        by_y = torch.cat([torch.eye(self.n_y, dtype=torch.float64), model.rest[self.n_y :, : self.n_y]])
        first = torch.zeros(n_a, n_a, dtype=torch.float64)
        first[self.n_y : n_x, self.n_y : n_x] = model.rest_cov[self.n_y :, self.n_y :]
        first[:n_x, :n_x] += (by_y * r) @ by_y.T
        first[n_x:, n_x:] = FIRST_LOAD**2 * torch.eye(loads.count, dtype=torch.float64)
        for name, values in {
            "q": torch.diag(q),
            "q_load": torch.diag(q_load),
            "r": r,
            "place": place.flatten(1),
            "first": first,
        }.items():
            self.register_buffer(name, values.contiguous())
        self.register_buffer("diagonal", torch.arange(self.n_y) * (n_a + 1))
        hold_numbers(
            self,
            forgetting=INNOVATION_FORGETTING,
            rise=(2 - INNOVATION_FORGETTING) / (RISE * INNOVATION_FORGETTING),
            fall=1 / FULL,
            calming=CALMING,
            swings=SWING_WEIGHT,
        )

    def forward(
        self, y: Tensor, v: Tensor, past: StateEstimate, fresh: Tensor | None = None, load_share: Tensor | None = None
    ) -> tuple[StateEstimate, Tensor]:
        """The estimate after the measurement, and the boost b (..., 1, n_y), 0 to 1.

        y (..., 1, n_y) and v (..., 1, n_v) scaled: what is measured now, and what acted over the last period. ``fresh``
        (..., 1, n_y) is 0 for an output that is not measured now, and 1 else: its correction is left out, and nothing
        is learnt of its innovations. ``load_share`` (..., 1, 1) multiplies the variance of the loads' changes.
        """
        mean, covariance = self.predicted(v, past)
        if load_share is not None:
            covariance = covariance + (load_share - 1.0) * self.q_load
        variance = covariance.flatten(-2).index_select(-1, self.diagonal).unsqueeze(-2)
        sd = torch.sqrt(variance + self.r)
        innovation = torch.clamp((y - mean[..., : self.n_y]) / sd, -OUTLIER, OUTLIER)
        learning = self.forgetting if fresh is None else self.forgetting * fresh
        drift = past.drift + learning * (innovation - past.drift)
        signed = innovation * innovation.abs()
        calming = self.calming if fresh is None else self.calming * torch.cat([fresh, fresh], dim=-1)
        squares = past.squares + calming * (torch.cat([signed.abs(), signed], dim=-1) - past.squares)
        both = squares[..., : self.n_y] - squares[..., self.n_y :].abs()
        calm = torch.clamp(1.0 + self.swings * (both - 1.0), min=1.0)
        boost = torch.clamp(self.rise * drift * drift / calm - 1.0, 0.0, FULL)
        if fresh is not None:
            boost = boost * fresh
        grown = boost if load_share is None else load_share * boost
        covariance = covariance + (grown @ self.place).reshape(covariance.shape)
        for o in range(self.n_y):
            row = covariance[..., o : o + 1, :]
            gain = row / (row[..., o : o + 1] + self.r[o : o + 1])
            if fresh is not None:
                gain = gain * fresh[..., o : o + 1]
            mean = mean + gain * (y[..., o : o + 1] - mean[..., o : o + 1])
            covariance = covariance - gain.reshape(*gain.shape[:-2], self.n_a, 1) * row
        return StateEstimate(mean, covariance, drift, squares), self.fall * boost

    def ahead(self, mean: Tensor, v: Tensor) -> Tensor:
        """[x, d] (..., 1, n_a) one period on under v."""
        return self._advanced(mean, v)[0]

    def predicted(self, v: Tensor, past: StateEstimate) -> tuple[Tensor, Tensor]:
        """Mean and covariance one period on, before the measurement."""
        mean, t = self._advanced(past.mean, v)
        if t is None:
            return mean, self.f @ past.covariance @ self.f_t + self.q
        slope = 1.0 - t * t
        f = product(self.w2 * slope, self.w1, self.f)
        f_t = product(self.w1_t * slope, self.w2_t, self.f_t)
        return mean, product(f @ past.covariance, f_t, self.q)

    def _advanced(self, mean: Tensor, v: Tensor) -> tuple[Tensor, Tensor | None]:
        """[x, d] one period on under v, and what the tanh units put out (None without them)."""
        now = self.step(torch.cat([mean, v], dim=-1))
        if not self.nonlinear:
            return now["next"], None
        t = torch.tanh(now["hidden"])
        return product(t, self.w2_t, now["next"]), t


def _with_loads(found: dict[str, Tensor], d: Tensor) -> dict[str, Tensor]:
    """The pieces of a step with ``next`` of [x, d]: loads stay as they are."""
    return {**found, "next": torch.cat([found["next"], d], dim=-1)}
