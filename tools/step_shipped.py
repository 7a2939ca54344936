"""Step every shipped controller over fixed samples: ``python tools/step_shipped.py FOLDER OUT.npz``.

Needs numpy, onnxruntime and ``serving`` alone: it runs wherever a controller runs. OUT.npz holds one
array a controller, named CASE/NAME, shape (STEPS, n_mv + n_state + n_info), float64.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from loopwright.serving import Controller
from loopwright.serving.manifest import Manifest, Signal

STEPS = 200
Array = NDArray[np.float64]


def samples(m: Manifest) -> Iterator[dict[str, Array]]:
    """Set points step, process variables follow them with noise, disturbances and the applied MV wander.

    The applied MV is not the commanded one: a law that sits at the end of its range would compute
    nothing there. Sums and products alone: no last bit depends on the version of numpy.
    """
    rng = np.random.default_rng(0)
    at = {name: rng.random(len(signals)) for name, signals in (("sp", m.sp), ("pv", m.pv), ("dv", m.dv), ("mv", m.mv))}
    for k in range(STEPS):
        if k % 40 == 0:
            at["sp"] = 0.2 + 0.6 * rng.random(len(m.sp))
        goal = np.concatenate([at["sp"], rng.random(len(m.pv))])[: len(m.pv)]
        at["pv"] = 0.9 * at["pv"] + 0.1 * goal + 0.02 * (rng.random(len(m.pv)) - 0.5)
        for name in ("dv", "mv"):
            at[name] = 0.8 * at[name] + 0.2 * rng.random(len(at[name]))
        yield {
            "sp": _scaled(m.sp, at["sp"]),
            "pv": _scaled(m.pv, at["pv"]),
            "dv": _scaled(m.dv, at["dv"]),
            "mv_applied": _scaled(m.mv, at["mv"]),
        }


def _scaled(signals: tuple[Signal, ...], at: Array) -> Array:
    """Values at the fractions ``at`` of the signals' ranges, in engineering units."""
    return np.array([s.low + (s.high - s.low) * x for s, x in zip(signals, at, strict=True)])


def trajectory(path: Path) -> Array:
    """MV, state and info of every step, the state fed back; shape (STEPS, n_mv + n_state + n_info)."""
    controller = Controller(path)
    state, steps = controller.cold_state(), []
    for sample in samples(controller.manifest):
        step = controller.step(**sample, state=state)
        state = step.state
        steps.append(np.concatenate(step))
    return np.array(steps)


def main(folder: Path, out: Path) -> None:
    """Write the trajectories of every ``folder``/CASE/NAME.onnx to ``out``."""
    files = sorted(folder.glob("*/*.onnx"))
    np.savez(out, **{f"{file.parent.name}/{file.stem}": trajectory(file) for file in files})


if __name__ == "__main__":
    if len(sys.argv) != 3:
        sys.exit("usage: python tools/step_shipped.py FOLDER OUT.npz")
    main(Path(sys.argv[1]), Path(sys.argv[2]))
