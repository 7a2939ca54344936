"""A plant that is known by a model of its record alone."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from pipeline.errors import PlantError
from pipeline.plants.signals import Signals
from pipeline.plants.simulator import AdvanceMany, Array, Simulator

RESTING = 20_000  # samples within which a model comes to rest, if it ever does
STILL = 1e-9  # scaled change a sample


@dataclass(frozen=True, slots=True, eq=False)
class Identification:
    """The numbers of a model, as its file holds them, and where an experiment starts."""

    arrays: Mapping[str, Array]  # a, b, c, w1, b1, w2, y_center, y_scale, v_center, v_scale, noise
    mv0: Array  # (n_mv,)
    dv0: Array  # (n_dv,)


class IdentifiedPlant(Simulator):
    """A state-space model in place of the plant.

        x+ = A x + B v + c + W2 tanh(W1 [x, v] + b1),     y = y0 + gain (x[:n_y] - y0)

    in scaled variables, with v = [MVs + load, measured disturbances], and y0 the outputs at rest under the MVs of
    the start. Its parameters make a plant that differs from its model: ``gain`` [-] of the outputs, and
    ``load_<MV>`` [unit of the MV], a disturbance that acts as the MV does, through all lags.

    A subclass states the signals, see ``plant_of``. ``load`` gives the numbers when they are first needed: before
    the model is trained, only the signals are known.
    """

    def __init__(self, load: Callable[[], Identification]) -> None:
        self.load = load

    @cached_property
    def model(self) -> Identification:
        """The model's numbers."""
        return self.load()

    @property
    def dv_nominal(self) -> Array:
        """Measured disturbances at the start, shape (n_dv,)."""
        return self.model.dv0

    @property
    def noise_std(self) -> Array:
        """Standard deviation of the measurement noise [units of the PVs], (n_pv,), as the model estimates it."""
        return np.asarray(self.model.arrays["noise"] * self.model.arrays["y_scale"])

    @classmethod
    def parameter_names(cls) -> tuple[str, ...]:
        """``gain``, and a load for each MV."""
        return ("gain", *(f"load_{s.name}" for s in cls.mv_signals))

    @classmethod
    def parameter_units(cls) -> dict[str, str]:
        """Unit of each parameter."""
        return {"gain": "-", **{f"load_{s.name}": s.unit for s in cls.mv_signals}}

    def parameters(self, changed: Mapping[str, float] | None = None) -> Array:
        """Gain 1 and no load, with some of them changed by name; PlantError for an unknown name."""
        values = dict.fromkeys(self.parameter_names(), 0.0) | {"gain": 1.0}
        for key, value in (changed or {}).items():
            if key not in values:
                raise PlantError(f"plant {self.name!r} has no parameter {key!r}; it has {', '.join(values)}")
            values[key] = float(value)
        return np.array(list(values.values()))

    @cached_property
    def start(self) -> tuple[Array, Array]:
        """(x, mv0) at rest under the MV of the start; PlantError where the model does not come to rest.

        The state holds the gain last: the measurement depends on it.
        """
        return np.append(self.at_rest(self.model.mv0), 1.0), self.model.mv0

    def at_rest(self, mv: Array) -> Array:
        """The model's state at rest under mv (n_mv,), shape (n_x,); PlantError where it does not come to rest."""
        x, v = np.zeros(len(self.model.arrays["c"])), self._scaled(mv, self.model.dv0)
        for _ in range(RESTING):
            before, x = x, self._next(x, v)
            if not np.isfinite(x).all():
                break
            if np.abs(x - before).max() <= STILL:
                return x
        under = ", ".join(f"{s.name} = {u:g}" for s, u in zip(self.mv_signals, mv, strict=True))
        raise PlantError(
            f"plant {self.name!r}: its model does not come to rest under {under}; record more of the plant, or choose "
            "an MV within the range of the record"
        )

    def step(self, x: Array, mv: Array, dv: Array, p: Array) -> Array:
        """One period on; the state is the model's and the gain."""
        return np.append(self._next(x[:-1], self._scaled(mv + p[1:], dv)), p[0])

    def measure(self, x: Array) -> Array:
        """The outputs [units of the PVs]."""
        return self._outputs(x)

    def measured(self, x: Array) -> Array:
        """Outputs (..., n_pv) of states (..., n_x)."""
        return self._outputs(x)

    def _outputs(self, x: Array) -> Array:
        y0, n_y = self.start[0], len(self.pv_signals)
        y = y0[:n_y] + x[..., -1:] * (x[..., :n_y] - y0[:n_y])
        return np.asarray(self.model.arrays["y_center"] + self.model.arrays["y_scale"] * y)

    def many(self, n: int) -> AdvanceMany:
        """``step`` of ``n`` runs side by side."""
        dv, p = np.tile(self.dv_nominal, (n, 1)), self.parameters()

        def advance(x: Array, mv: Array) -> Array:
            return np.column_stack([self._next(x[:, :-1], self._scaled(mv + p[1:], dv)), x[:, -1]])

        return advance

    def _next(self, x: Array, v: Array) -> Array:
        a = self.model.arrays
        hidden = np.tanh(np.concatenate([x, v], axis=-1) @ a["w1"].T + a["b1"])
        return np.asarray(x @ a["a"].T + v @ a["b"].T + a["c"] + hidden @ a["w2"].T)

    def _scaled(self, mv: Array, dv: Array) -> Array:
        a = self.model.arrays
        return np.asarray((np.concatenate([mv, dv], axis=-1) - a["v_center"]) / a["v_scale"])


def plant_of(name: str, title: str, signals: Signals) -> type[IdentifiedPlant]:
    """The class of an identified plant with these signals."""
    groups = {f"{group}_signals": getattr(signals, group) for group in ("pv", "sp", "mv", "dv")}
    return type("OwnPlant", (IdentifiedPlant,), {"name": name, "title": title, "period_s": signals.period_s, **groups})
