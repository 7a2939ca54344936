"""Digests of plants: whether a figure that was computed on a plant still is one of it."""

from __future__ import annotations

import ast
import contextlib
import inspect
import textwrap

import numpy as np

from loopwright.pipeline.errors import PlantError
from loopwright.pipeline.files import digest
from loopwright.pipeline.plants.equations import EquationPlant
from loopwright.pipeline.plants.identified import IdentifiedPlant
from loopwright.pipeline.plants.simulator import Simulator


def plant_digest(plant: Simulator) -> str:
    """sha256 of a plant of any kind, its parameters among the rest.

    A class of another kind counts by its text where Python can read it, else by its name; so does one in equations
    whose discrete MV has no relaxation.
    """
    if isinstance(plant, IdentifiedPlant):
        return identified_digest(plant)
    if isinstance(plant, EquationPlant):
        with contextlib.suppress(PlantError):
            return equations_digest(plant)
    try:
        text = ast.unparse(ast.parse(textwrap.dedent(inspect.getsource(type(plant)))))
    except (OSError, TypeError):
        text = type(plant).__qualname__
    return digest([text, plant.name, plant.period_s, [f"{v:.9g}" for v in plant.parameters()]])


def identified_digest(plant: IdentifiedPlant) -> str:
    """sha256 of the equation, where the plant starts, and the ranges that errors and moves are counted in."""
    f = plant.arrays
    numbers = (f.a, f.b, f.c, f.w1, f.b1, f.w2, f.y_center, f.y_scale, f.v_center, f.v_scale, *plant.start)
    ranges = [[s.low, s.high] for s in (*plant.sp_signals, *plant.mv_signals)]
    moves = [s.max_move for s in plant.mv_signals]
    limits = [moves] if any(moves) else []
    return digest([[f"{v:.9g}" for v in np.ravel(array)] for array in numbers] + [ranges, plant.period_s, *limits])


def equations_digest(plant: EquationPlant) -> str:
    """sha256 of the plant's equations, parameters and sampling; comments and layout do not count.

    An output of its own mostly calls other functions, so it counts by its values over the states'
    ranges, six digits of them; the rates too, whose constants may stand outside of ``derivative``.
    A plant with a discrete MV counts with the values of its relaxation.
    """
    source = ast.parse(textwrap.dedent(inspect.getsource(type(plant).derivative)))
    function = source.body[0]
    if isinstance(function, ast.FunctionDef) and ast.get_docstring(function) is not None:
        function.body = function.body[1:]
    names = dict(zip(plant.parameter_names(), plant.parameters().tolist(), strict=True))
    what = [ast.unparse(source), names, plant.period_s, plant.time_unit_s, plant.substeps]
    if not plant.measures_states:
        what.append(_probe(plant))
    if any(s.values is not None for s in plant.mv_signals):
        what.append(_probe(plant.relaxed()))
    return digest(what)


def _probe(plant: EquationPlant) -> list[str]:
    signals = (*plant.state_signals, *plant.mv_signals)
    low, high = (np.array([getattr(s, end) for s in signals]) for end in ("low", "high"))
    digits = []
    for fractions in np.random.default_rng(0).uniform(0.1, 0.9, (7, len(signals))):
        x, mv = np.split(low + fractions * (high - low), [len(plant.state_signals)])
        values = (plant.measure(x), plant.rate(x, mv, plant.dv_nominal, plant.parameters()))
        digits += [f"{v:.6g}" for v in np.concatenate([np.array(v).ravel() for v in values])]
    return digits
