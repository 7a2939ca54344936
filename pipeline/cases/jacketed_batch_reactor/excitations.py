"""Excitation of a vessel with a hot and a cold valve: pulses that drive its jacket toward random targets."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from loopwright.pipeline.errors import PlantError
from loopwright.pipeline.excitation.base import Excitation, within
from loopwright.pipeline.plants.simulator import Array, Simulator
from loopwright.pipeline.records.record import Record
from loopwright.pipeline.simulation.simulate import noise_draws


@dataclass(frozen=True, kw_only=True)
class JacketPulses(Excitation):
    """Pulses of the throttle toward random targets: hot where a new target is above the jacket, cold below it.

    A throttle that moves at random in one mode drives the jacket to that mode's inlet temperature and leaves
    it there. Targets over the whole range bring the jacket everywhere in both modes, and pulses that are mostly
    small, or nothing, show what the throttle does and what the jacket does by itself. The mode stays until the
    next target, so that the jacket runs past its target, too; each pulse has an opening of its own.

    The plant's first MV is the throttle, its second the mode, whose allowed values are hot and cold, in this order;
    its second process variable is the jacket's temperature.

    Attributes
    ----------
    target_low, target_high [degC]
        Range of the targets, uniform.
    hold_low, hold_high [-]
        Fewest and most samples for which a target stays.
    pulse_low, pulse_high [-]
        Fewest and most samples of a pulse.
    opening [-]
        Mean of the exponential from which a pulse's throttle is drawn, as a fraction of the MV's range;
        more than the whole range counts as that.
    shut [-]
        Fraction of the pulses with the throttle at the low end, 0 to 1.
    """

    kind: ClassVar[str] = "jacket_pulses"
    target_low: float = 12.0
    target_high: float = 74.0
    hold_low: int = within(20, 1)
    hold_high: int = 79
    pulse_low: int = within(2, 1)
    pulse_high: int = 7
    opening: float = within(0.25, 0)
    shut: float = within(0.35, 0, 1)

    def __post_init__(self) -> None:
        super().__post_init__()
        self.require("hold_high", self.hold_low)
        self.require("pulse_high", self.pulse_low)
        self.require("target_high", self.target_low)

    def run(self, plant: Simulator, seed: int) -> Record:
        """The record of one run from the plant's start; the modes answer to the jacket as it is measured.

        Raises PlantError for a plant without a throttle, a mode of two values and a second process variable.
        """
        throttle, values = self._valves(plant)
        rng = np.random.default_rng(seed)
        noise = noise_draws(plant, self.samples, self.noise, rng)
        step, dv, p = plant.stepper(), plant.dv_nominal, plant.parameters()
        state = plant.start[0]
        pv, mv = np.empty_like(noise), np.empty((self.samples, 2))
        mode = k_m = 0.0
        target_left = pulse_left = 0
        for k in range(self.samples):
            pv[k] = plant.measure(state) + noise[k]
            if target_left == 0:
                target = float(rng.uniform(self.target_low, self.target_high))
                target_left = int(rng.integers(self.hold_low, self.hold_high + 1))
                mode = values[0] if pv[k, 1] < target else values[1]
            if pulse_left == 0:
                pulse_left = int(rng.integers(self.pulse_low, self.pulse_high + 1))
                opening = 0.0 if rng.random() < self.shut else min(float(rng.exponential(self.opening)), 1.0)
                k_m = throttle[0] + opening * (throttle[1] - throttle[0])
            target_left, pulse_left = target_left - 1, pulse_left - 1
            mv[k] = k_m, mode
            state = step(state, mv[k], dv, p)
        return Record.of(plant.signals, pv, mv, dv=plant.dv_nominal)

    def _valves(self, plant: Simulator) -> tuple[Array, tuple[float, float]]:
        """Ends of the throttle's range, shape (2,), and the mode's two values."""
        mvs = plant.mv_signals
        modes = mvs[1].values if len(mvs) == 2 else None
        if len(plant.pv_signals) < 2 or mvs[0].values is not None or modes is None or len(modes) != 2:
            names = ", ".join(s.name for s in (*plant.pv_signals, *mvs))
            raise PlantError(
                f"plant {plant.name!r} has the signals {names}; {self.kind!r} needs two process variables, the second "
                "of them the jacket's temperature, a continuous MV and an MV with two allowed values, hot and cold"
            )
        return np.array([mvs[0].low, mvs[0].high]), (modes[0], modes[1])


EXCITATIONS: dict[str, type[Excitation]] = {JacketPulses.kind: JacketPulses}
