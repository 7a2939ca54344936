"""The nodes of one connection: what is asked at each reading, and what is written in which type."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import Enum
from typing import TypeAlias

import numpy as np
from asyncua import ua
from numpy.typing import NDArray

from loopwright.serving.errors import EndpointError, LoopError
from loopwright.serving.manifest import Manifest, OperateEntry, Signal
from loopwright.serving.opcua.link import Link
from loopwright.serving.opcua.node_lease import SeveralLeasesError, beside
from loopwright.serving.opcua.settings import NO_LEASE, Nodes, Point
from loopwright.serving.opcua.values import exact, variant
from loopwright.serving.words import first_line

Array: TypeAlias = NDArray[np.float64]


class Role(Enum):
    """Use of a node by a loop."""

    PV = "PV"
    MV = "MV"
    DV = "DV"
    SP = "SP"
    OPERATE = "operate"
    LOCAL = "local"
    MODE = "mode"
    WATCHDOG = "watchdog"
    HEARTBEAT = "heartbeat"
    HAND_BACK = "hand_back"
    LEASE = "lease"


@dataclass(frozen=True, slots=True)
class Row:
    """One node of a loop. ``judged``: a sample is only as good as its value. ``written``: the loop writes it.

    An MV has two rows, which are one node where nothing else is read back.
    """

    role: Role
    point: Point
    signal: Signal | None = None
    judged: bool = False
    written: bool = False
    entry: OperateEntry | None = None

    @property
    def title(self) -> str:
        """Role and signal, such as "MV T_j", or "operate T.low"."""
        of = self.entry if self.signal is None else self.signal
        return self.role.value if of is None else f"{self.role.value} {of.name}"

    @property
    def name(self) -> str:
        """The title; of a node that is written also that."""
        return f"{self.title}, written" if self.written else self.title

    @property
    def node(self) -> str:
        """Its id in loop.toml."""
        return self.point.node if self.written else self.point.read_back or self.point.node

    @property
    def request(self) -> bool:
        """Whether the plant's own operator asks for something by it."""
        return self.role in {Role.SP, Role.OPERATE, Role.MODE}

    @property
    def measured(self) -> bool:
        """Whether the loop computes with its number."""
        return not (self.written or self.request or self.role is Role.LOCAL)

    @property
    def ages(self) -> bool:
        """Whether its value grows stale: a measurement does, and a value that somebody set is as old as it is."""
        return self.judged and self.role is not Role.MV


class NodePlan:
    """The nodes of one connection, with the types that they have in it."""

    def __init__(self, nodes: Nodes, manifest: Manifest) -> None:
        self.nodes, self.manifest = nodes, manifest
        self.dvs = [s for s in manifest.dv if s.name in nodes.dv]
        pv, mv, dv, sp = (nodes.points(n) for n in ("pv", "mv", "dv", "sp"))
        used, wanted = "dv" in manifest.inputs, {s.name: s for s in manifest.sp}
        entries = {e.name: e for e in manifest.operate}
        self.rows = [
            *(Row(Role.PV, pv[s.name], s, judged=True) for s in manifest.pv),
            *(Row(Role.MV, mv[s.name], s, judged=True) for s in manifest.mv),
            *(Row(Role.DV, dv[s.name], s, judged=used) for s in self.dvs),
            *(Row(Role.SP, point, wanted[name]) for name, point in sp.items()),
            *(Row(Role.OPERATE, point, entry=entries[name]) for name, point in nodes.points("operate").items()),
        ]
        self.timed = [i for i, row in enumerate(self.rows) if row.ages]
        if nodes.mode is not None:
            self.rows.append(Row(Role.MODE, Point(nodes.mode.node)))
        if nodes.watchdog:
            self.rows.append(Row(Role.WATCHDOG, Point(nodes.watchdog)))
        mvs = {s.name: s for s in manifest.mv}
        self.rows += [Row(Role.LOCAL, Point(at.node), mvs[name]) for name, at in nodes.local.items()]
        self.outputs = [Row(Role.MV, mv[s.name], s, judged=True, written=True) for s in manifest.mv]
        self.extra = []
        if nodes.heartbeat:
            self.extra.append(Row(Role.HEARTBEAT, Point(nodes.heartbeat), judged=True, written=True))
        if nodes.hand_back is not None:
            self.extra.append(Row(Role.HAND_BACK, Point(nodes.hand_back.node), judged=True, written=True))
        self.asked: list[ua.NodeId] = []
        self.written: list[tuple[ua.NodeId, ua.VariantType]] = []
        self.heartbeat: tuple[ua.NodeId, ua.VariantType, int] | None = None
        self.lease: ua.NodeId | None = None  # read last, after the points
        self.unwritable = ""  # why no MV may be written on this connection
        self._hand_back: tuple[ua.NodeId, ua.VariantType] | None = None

    @classmethod
    async def made(cls, link: Link, manifest: Manifest, nodes: Nodes, timeout_s: float) -> NodePlan:
        """Ask the server for ids and types."""
        plan = cls(nodes, manifest)
        written = [*plan.outputs, *plan.extra]
        n, n_mv = len(plan.rows), len(plan.outputs)
        ids = await link.resolved([row.node for row in (*plan.rows, *written)], timeout_s)
        shared = shared_node(written, ids[n:])
        if shared:
            raise LoopError(shared)
        plan.asked, targets = ids[:n], ids[n : n + n_mv]
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
        kinds = [r.kind for r in await link.read(ids[n:], timeout_s)]
        for row, kind in zip(written, kinds, strict=True):
            if kind in {None, ua.VariantType.Null}:  # the node is not there now, or holds nothing yet
                raise EndpointError(f"{row.title}: the server gives no value, so its type is not known")
        typed = [(i, k) for i, k in zip(ids[n:], kinds, strict=True) if k is not None]
        plan.written, rest = typed[:n_mv], typed[n_mv:]
        if nodes.heartbeat:
            (node, kind), *rest = rest
            plan.beat_in(node, kind)
        if nodes.hand_back is not None:
            plan._hand_back = rest[0]
        return plan

    def measuring(self) -> list[tuple[Row, ua.NodeId]]:
        """The nodes whose numbers the loop uses: those that are read for it, and the MVs that it writes."""
        read = zip(self.rows, self.asked, strict=False)
        written = zip(self.outputs, self.written, strict=True)
        return [
            *((row, at) for row, at in read if row.judged or row.role in {Role.SP, Role.OPERATE}),
            *((row, at) for row, (at, _) in written),
        ]

    def beat_in(self, node: ua.NodeId, kind: ua.VariantType) -> None:
        """Count the heartbeat in this type of its node."""
        self.heartbeat = (node, kind, 2 if kind is ua.VariantType.Boolean else 100)

    def variants(self, mv: Array) -> list[tuple[ua.NodeId, ua.Variant]]:
        """Values to write for an MV (n_mv,): raw numbers in the nodes' own types, within the range."""
        rows = []
        signals = zip(self.written, self.outputs, self.manifest.mv, mv.tolist(), strict=True)
        for (node, kind), row, s, value in signals:
            point = row.point
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


def shared_node(rows: Sequence[Row], ids: Sequence[ua.NodeId]) -> str:
    """Why nodes cannot be written: that of an MV is that of something else, too. Empty: each has its own."""
    for i, row in enumerate(rows):
        others = [other.title for k, other in enumerate(rows) if k != i and ids[k] == ids[i]]
        if others and row.role is Role.MV:
            return f"{row.title} and {', '.join(others)} are one node, {ids[i].to_string()}; give each its own"
    return ""
