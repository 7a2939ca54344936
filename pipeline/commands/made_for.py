"""Whether a controller was made for a plant."""

from __future__ import annotations

from loopwright.pipeline.errors import ParamsError
from loopwright.pipeline.plants.simulator import Simulator
from loopwright.serving.manifest import Manifest


def require_made_for(manifest: Manifest, plant: Simulator) -> None:
    """Raise ParamsError where a controller's signals, their units or its period are not the plant's."""
    for name in ("sp", "pv", "dv", "mv"):
        ours = [(s.name, s.unit) for s in getattr(plant, f"{name}_signals")]
        theirs = [(s.name, s.unit) for s in manifest.signals(name)]
        if ours != theirs:
            raise ParamsError(f"the controller's {name} are {theirs}, but plant {plant.name!r} has {ours}")
    if manifest.period_s != plant.period_s:
        raise ParamsError(
            f"the controller's period is {manifest.period_s} s, but plant {plant.name!r} has {plant.period_s}"
        )
