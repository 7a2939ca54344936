"""A small law that reads ``operate`` and ``fresh`` and tells what it was given. Not a test."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from loopwright.pipeline.laws import ControlLaw
from loopwright.pipeline.plants.simulator import Signals
from loopwright.serving import Signal
from loopwright.serving.manifest import Manifest, OperateEntry

T, P, X = Signal("T", "K", 250.0, 400.0), Signal("p", "bar", 0.0, 10.0), Signal("x", "-", 0.0, 1.0)
VALVE, HEAT = Signal("valve", "%", 0.0, 100.0), Signal("heat", "kW", -1.0, 1.0)
PLANT = Signals(1.0, (T, P), (T, P, X), (), (VALVE, HEAT))
FASTEST = 5.0  # % a period
ENTRIES = (
    OperateEntry("cv", "T", "use", "", 1.0, 0.0, 1.0),
    OperateEntry("cv", "T", "low", "K", 250.0, 250.0, 400.0),
    OperateEntry("cv", "T", "high", "K", 400.0, 250.0, 400.0),
    OperateEntry("cv", "p", "use", "", 1.0, 0.0, 1.0),
    OperateEntry("mv", "valve", "use", "", 1.0, 0.0, 1.0),
    OperateEntry("mv", "valve", "low", "%", 0.0, 0.0, 100.0),
    OperateEntry("mv", "valve", "high", "%", 100.0, 0.0, 100.0),
    OperateEntry("mv", "valve", "max_move", "%", FASTEST, 0.1, FASTEST),
    OperateEntry("law", "", "speed", "", 1.0, 0.25, 4.0),
)
OTHER_ENTRIES = (  # of a law that lacks some, has another one, and other defaults
    OperateEntry("mv", "valve", "low", "%", 10.0, 0.0, 50.0),
    OperateEntry("mv", "valve", "high", "%", 90.0, 50.0, 100.0),
    OperateEntry("cv", "p", "use", "", 1.0, 0.0, 1.0),
    OperateEntry("law", "", "caution", "", 2.0, 0.25, 4.0),
)
NARROW_ENTRIES = (  # of a law whose engineered range does not hold the defaults of ``ENTRIES``
    OperateEntry("mv", "valve", "low", "%", 20.0, 10.0, 80.0),
    OperateEntry("mv", "valve", "high", "%", 80.0, 10.0, 80.0),
)


class OperatedLaw(ControlLaw):
    """The valve follows T and p as they are fresh and in use; the info is all that the law was given of both inputs."""

    name, title, Params = "operated", "Operated", type(None)

    def __init__(self, entries: tuple[OperateEntry, ...], signals: Signals = PLANT) -> None:
        super().__init__(signals)
        self.operate, self.n_state = entries, 1
        names = [e.name for e in entries]
        self.info = (*names, *(f"fresh {s.name}" for s in signals.pv), *(f"pv {s.name}" for s in signals.pv))
        self.at = {name: i for i, name in enumerate(names)}

    @classmethod
    def design(cls, params: Any, models: Any, signals: Signals, plant: Any) -> OperatedLaw:
        raise NotImplementedError

    def _of(self, operate: Tensor, name: str, default: float) -> Tensor:
        at = self.at.get(name)
        return torch.full_like(operate[..., :1], default) if at is None else operate[..., at : at + 1]

    def forward(
        self, sp: Tensor, pv: Tensor, dv: Tensor, mv_applied: Tensor, state: Tensor, operate: Tensor, fresh: Tensor
    ) -> Any:
        of = operate
        wanted = self._of(of, "T.use", 1.0) * fresh[..., :1] * (sp[..., :1] - pv[..., :1])
        wanted = wanted + 10 * self._of(of, "p.use", 1.0) * fresh[..., 1:2] * (sp[..., 1:] - pv[..., 1:2])
        most = self._of(of, "valve.max_move", FASTEST)
        at = mv_applied[..., :1]
        into = torch.minimum(
            torch.maximum(at + self._of(of, "speed", 1.0) * wanted, self._of(of, "valve.low", 0.0)),
            self._of(of, "valve.high", 100.0),
        )
        move = torch.minimum(torch.maximum(into - at, -most), most) * self._of(of, "valve.use", 1.0)
        mv = torch.cat([at + move, 0.5 + 0.0 * mv_applied[..., 1:]], dim=-1)
        return self.limited(mv, mv_applied), state + 1.0, torch.cat([operate, fresh, pv], dim=-1)


@dataclass(frozen=True)
class Given:
    """What a law was given, by its info."""

    operate: dict[str, float]
    fresh: dict[str, float]
    pv: dict[str, float]

    @classmethod
    def of(cls, manifest: Manifest, info: np.ndarray | None) -> Given:
        """Read it."""
        assert info is not None
        found = dict(zip(manifest.info, info.tolist(), strict=True))
        fresh, pv = (
            {n.split(" ")[1]: v for n, v in found.items() if n.startswith(f"{kind} ")} for kind in ("fresh", "pv")
        )
        return cls({e.name: found[e.name] for e in manifest.operate}, fresh, pv)
