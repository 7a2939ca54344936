"""The nodes of one connection: what is asked at each reading, and what is written in which type."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TypeAlias

import numpy as np
from asyncua import ua
from numpy.typing import NDArray

from serving.errors import EndpointError, LoopError
from serving.manifest import Manifest
from serving.opcua.lease import SeveralLeasesError, beside
from serving.opcua.link import Link
from serving.opcua.settings import NO_LEASE, Nodes, Point
from serving.opcua.values import exact, variant
from serving.words import first_line

Array: TypeAlias = NDArray[np.float64]


class Plan:
    """The nodes of one connection, with the types that they have in it."""

    def __init__(self, nodes: Nodes, manifest: Manifest) -> None:
        self.nodes, self.manifest = nodes, manifest
        self.dv_names = [s.name for s in manifest.dv if s.name in nodes.dv]
        pv, mv, dv, sp = (nodes.points(n) for n in ("pv", "mv", "dv", "sp"))
        used = "dv" in manifest.inputs
        # (name, how it is scaled, whether the sample is only as good as this value)
        self.points: list[tuple[str, Point, bool]] = [
            *((f"PV {s.name}", pv[s.name], True) for s in manifest.pv),
            *((f"MV {s.name}", mv[s.name], True) for s in manifest.mv),
            *((f"DV {name}", dv[name], used) for name in self.dv_names),
            *((f"SP {name}", point, False) for name, point in sp.items()),
        ]
        # A value that somebody set is as old as it is: only measurements grow stale.
        self.timed = [i for i, (name, _, judged) in enumerate(self.points) if judged and not name.startswith("MV ")]
        if nodes.mode is not None:
            self.points.append(("mode", Point(nodes.mode.node), False))
        if nodes.watchdog:
            self.points.append(("watchdog", Point(nodes.watchdog), False))
        self.mv_names = [s.name for s in manifest.mv]
        self.mv_points = [mv[s.name] for s in manifest.mv]
        self.asked: list[ua.NodeId] = []
        self.written: list[tuple[ua.NodeId, ua.VariantType]] = []
        self.heartbeat: tuple[ua.NodeId, ua.VariantType, int] | None = None
        self.lease: ua.NodeId | None = None  # read last, after the points
        self.unwritable = ""  # why no MV may be written on this connection
        self._hand_back: tuple[ua.NodeId, ua.VariantType] | None = None

    @classmethod
    async def made(cls, link: Link, manifest: Manifest, nodes: Nodes, timeout_s: float) -> Plan:
        """Ask the server for ids and types."""
        plan = cls(nodes, manifest)
        texts = [p.read_back or p.node for _, p, _ in plan.points]
        others = {"heartbeat": nodes.heartbeat, "hand_back": "" if nodes.hand_back is None else nodes.hand_back.node}
        extra = [name for name, node in others.items() if node]
        ids = await link.resolved(
            [*texts, *(p.node for p in plan.mv_points), *(others[name] for name in extra)], timeout_s
        )
        names = [*(f"MV {n}" for n in plan.mv_names), *extra]
        shared = shared_node(names, ids[len(texts) :])
        if shared:
            raise LoopError(shared)
        plan.asked, targets = ids[: len(texts)], ids[len(texts) : len(texts) + len(plan.mv_points)]
        if nodes.lease == NO_LEASE:
            plan.lease = None
        elif nodes.lease:
            (plan.lease,) = await link.resolved([nodes.lease], timeout_s)
        else:
            try:
                plan.lease = await beside(link, dict.fromkeys(targets), timeout_s)
            except SeveralLeasesError as error:
                plan.unwritable = f"lease: {first_line(error)}"
        plan.asked += [plan.lease] if plan.lease is not None else []
        kinds = [r.kind for r in await link.read(ids[len(texts) :], timeout_s)]
        for name, kind in zip(names, kinds, strict=True):
            if kind in {None, ua.VariantType.Null}:  # the node is not there now, or holds nothing yet
                raise EndpointError(f"{name}: the server gives no value, so its type is not known")
        typed = [(i, k) for i, k in zip(ids[len(texts) :], kinds, strict=True) if k is not None]
        plan.written, rest = typed[: len(plan.mv_points)], typed[len(plan.mv_points) :]
        if nodes.heartbeat:
            (node, kind), *rest = rest
            plan.beat_in(node, kind)
        if nodes.hand_back is not None:
            plan._hand_back = rest[0]
        return plan

    def measuring(self) -> list[tuple[str, Point, ua.NodeId]]:
        """The nodes whose numbers the loop uses, by name and scale: what is read for it, and the MVs that it writes."""
        read = [(n, p, at) for (n, p, judged), at in zip(self.points, self.asked, strict=False)
                if (judged or n.startswith("SP "))]  # fmt: skip
        written = zip(self.mv_names, self.mv_points, self.written, strict=True)
        return [*read, *((f"MV {n}, written", p, at) for n, p, (at, _) in written)]

    def beat_in(self, node: ua.NodeId, kind: ua.VariantType) -> None:
        """Count the heartbeat in this type of its node."""
        self.heartbeat = (node, kind, 2 if kind is ua.VariantType.Boolean else 100)

    def variants(self, mv: Array) -> list[tuple[ua.NodeId, ua.Variant]]:
        """Values to write for an MV (n_mv,): raw numbers in the nodes' own types, within the range."""
        rows = []
        signals = zip(self.written, self.mv_points, self.manifest.mv, mv.tolist(), strict=True)
        for (node, kind), point, s, value in signals:
            low, high = sorted(((s.low - point.offset) / point.scale, (s.high - point.offset) / point.scale))
            raw = min(max((value - point.offset) / point.scale, low), high)
            rows.append((node, variant(raw, kind, low, high)))
        return rows

    def hand_back(self) -> tuple[ua.NodeId, ua.Variant]:
        """Values to write to hand the plant back."""
        assert self._hand_back is not None
        assert self.nodes.hand_back is not None
        (node, kind), value = self._hand_back, self.nodes.hand_back.value
        return node, exact(value, kind)


def shared_node(names: Sequence[str], ids: Sequence[ua.NodeId]) -> str:
    """Why nodes cannot be written: that of an MV is that of something else, too. Empty: each has its own."""
    for i, name in enumerate(names):
        others = [n for k, n in enumerate(names) if k != i and ids[k] == ids[i]]
        if others and name.startswith("MV "):
            return f"{name} and {', '.join(others)} are one node, {ids[i].to_string()}; give each its own"
    return ""
