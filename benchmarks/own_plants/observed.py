"""What a controller could reach that knows the equations and measures what ours does: the NMPC behind a Kalman filter.

The NMPC of ``bound_of`` is told the state and what moves by itself, and has no noise. This one has an extended Kalman
filter over the true equations: z = [x, q], q the unmeasured loads and what else moves,

    q(k+1) = m + a (q(k) - m) + w(k).

It starts from the true state, knows a, m and the size of w of what wanders, and takes measured disturbances as shown.
How fast loads at the MVs may move is no fact of the plant: a filter that follows them fast lets more noise through, so
that there is a figure for each pace. The planner takes the estimates for certain: a bound it is not.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass

import casadi as ca
import numpy as np
from closed_plant import ClosedPlant
from loops import LoopTest, Score, noise_of, scores, tests_of
from plant import OwnPlant
from store import bound_of, nmpc_of

from loopwright.pipeline.plants.simulator import Array

PACES = (0.03, 0.1, 0.3, 1.0)  # of loads at the MVs [% of the valve a sample], or times what wanders really does
DRIFT_SEEN = 5_000  # samples of a drift from which the size of its steps is known
SMALL = 1e-9  # of a state's variance: the equations are exact


@dataclass(frozen=True, slots=True)
class Moving:
    """A parameter that nobody measures: where it goes by itself, how much is left after a sample, its pushes' sd."""

    name: str
    mean: float
    kept: float
    sd: float


def moving_of(plant: OwnPlant, pace: float) -> list[Moving]:
    """What drifts, and of a closed plant its wandering loads, of others a load at each MV."""
    courses = plant.drift(DRIFT_SEEN, np.random.default_rng(0))
    known = [m.parameter for m in plant.measured_disturbances] if isinstance(plant, ClosedPlant) else []
    wanders = plant.wanders if isinstance(plant, ClosedPlant) else ()
    loads = [] if isinstance(plant, ClosedPlant) else [Moving(name, 0.0, 1.0, pace) for name in plant.load_names()]
    for w in wanders:
        kept = float(np.exp(-1 / w.samples))
        loads.append(Moving(w.parameter, getattr(plant, w.parameter), kept, pace * w.sd * float(np.sqrt(1 - kept**2))))
    others = {n: c for n, c in courses.items() if n not in known and n not in {w.parameter for w in wanders}}
    return loads + [Moving(n, 0.0, 1.0, float(np.sqrt(np.mean(np.diff(c) ** 2)))) for n, c in others.items()]


class Observer:
    """An extended Kalman filter of the states and of the parameters that move, from the truth at the start."""

    def __init__(self, plant: OwnPlant, moving: list[Moving], x: Array, parameters: Array) -> None:
        self.plant, self.moving = plant, moving
        self.at = [plant.parameter_names().index(m.name) for m in moving]
        self.z = np.concatenate([x, parameters[self.at]])
        self.cov = SMALL * np.eye(len(self.z))
        self.pushes = np.concatenate([np.full(len(x), SMALL), [m.sd**2 for m in moving]])
        state, mv, p = ca.SX.sym("x", len(x)), ca.SX.sym("u", len(plant.mv_signals)), ca.SX.sym("p", len(parameters))
        after, seen = plant.transition(state, mv, ca.DM.zeros(0, 1), p), plant.measurement(state)
        ways = [after, ca.jacobian(after, state), ca.jacobian(after, p)]
        self.advance = ca.Function("advance", [state, mv, p], [ca.densify(way) for way in ways])
        self.look = ca.Function("look", [state], [seen, ca.densify(ca.jacobian(seen, state))])

    def told(self, parameters: Array) -> Array:
        """The parameters (n_p,) with those that move as the filter has them."""
        filled = np.array(parameters)
        filled[self.at] = self.z[len(self.z) - len(self.at) :]
        return filled

    def see(self, pv: Array) -> None:
        """Correct by a measurement (n_pv,)."""
        n = len(self.z) - len(self.at)
        seen, by_state = (np.array(v) for v in self.look(self.z[:n]))
        by = np.hstack([by_state, np.zeros((len(pv), len(self.at)))])
        spread = by @ self.cov @ by.T + np.diag(self.plant.noise_std**2)
        gain = np.linalg.solve(spread, by @ self.cov).T
        self.z = self.z + gain @ (pv - seen[:, 0])
        self.cov = self.cov - gain @ spread @ gain.T

    def go_on(self, mv: Array, parameters: Array) -> None:
        """To the next sample, under MVs (n_mv,)."""
        n = len(self.z) - len(self.at)
        after, by_state, by_parameter = (np.array(v) for v in self.advance(self.z[:n], mv, self.told(parameters)))
        kept, mean = (np.array([getattr(m, of) for m in self.moving]) for of in ("kept", "mean"))
        by = np.block([[by_state, by_parameter[:, self.at]], [np.zeros((len(kept), n)), np.diag(kept)]])
        self.z = np.concatenate([after[:, 0], mean + kept * (self.z[n:] - mean)])
        self.cov = by @ self.cov @ by.T + np.diag(self.pushes)


def observed(plant: OwnPlant, tests: list[LoopTest], pace: float) -> Score:
    """The scores of the NMPC behind the filter, with the noise that ``loops.closed`` gives a law."""
    nmpc, moving = nmpc_of(plant, every=1), moving_of(plant, pace)
    measured = [m.parameter for m in plant.measured_disturbances] if isinstance(plant, ClosedPlant) else []
    places = [plant.parameter_names().index(name) for name in measured]
    ys, us = [], []
    for test in tests:
        scenario = test.scenario
        true, noise = scenario.parameters(plant), noise_of(plant, scenario)
        given = np.tile(plant.parameters(), (scenario.samples, 1))
        given[:, places] = plant.known(scenario)
        nmpc.reset()
        x, filtered = scenario.x0, Observer(plant, moving, scenario.x0, true[0])
        y, u = [], []
        for k in range(scenario.samples):
            y.append(plant.measure(x) + test.upset[k])
            filtered.see(y[-1] + noise[k])
            u.append(nmpc.step(filtered.z[: len(x)], scenario.sp[k], filtered.told(given[k])))
            filtered.go_on(u[-1], given[k])
            x = plant.step(x, u[-1], plant.dv_nominal, true[k])
        if nmpc.failures:
            print(f"  {plant.name}: nothing could be solved at {nmpc.failures} samples", file=sys.stderr)
        ys.append(y)
        us.append(u)
    return scores(plant, tests, np.array(ys), np.array(us))


def observed_main(plants: list[OwnPlant], sequences: int) -> int:
    """Print a row a plant whose NMPC comes to an end: ``bound_of``, and errors on set points and loads by pace."""
    print(f"{'':12} {'NMPC':>6}" + "".join(f" | pace {pace:<7g}" for pace in PACES))
    for plant in (p for p in plants if p.bounded):
        own = plant.bounding if isinstance(plant, ClosedPlant) else plant
        tests = tests_of(own)
        cells = [f"{plant.name:12} {bound_of(own, sequences):6.2f}"]
        for pace in PACES:
            held = observed(own, tests["set points"][:sequences], pace).nmae
            # The filter of a closed plant knows what wanders there, and no steps at the MVs.
            pushed = np.nan if isinstance(own, ClosedPlant) else observed(own, tests["loads"][:sequences], pace).nmae
            cells.append(f"{held:5.2f} {pushed:6.2f}")
        print(" | ".join(cells), flush=True)
    return 0
