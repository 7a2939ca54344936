"""Every node of a loop, read once: what is there, and what would stop the loop."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from asyncua import ua

from loopwright.serving.errors import EndpointError
from loopwright.serving.guard import InRange, Sample, implausible
from loopwright.serving.manifest import SWITCHES, Manifest, Signal
from loopwright.serving.opcua.certificates import last_day, valid_until
from loopwright.serving.opcua.link import Link
from loopwright.serving.opcua.nameplates import (
    Identity,
    Plate,
    by_name,
    identity,
    numbers,
    other_unit,
    plates,
    renumbered,
    uri_of,
    whole,
)
from loopwright.serving.opcua.node_lease import NAME, WRITABLE, SeveralLeasesError, beside
from loopwright.serving.opcua.plan import NodePlan, Role, Row, shared_node
from loopwright.serving.opcua.sampling import NO_NUMBERS
from loopwright.serving.opcua.settings import NO_LEASE, LocalNode, Nodes, Point, Server
from loopwright.serving.opcua.values import (
    FLOATS,
    INTEGERS,
    STATUS_BAD,
    STATUS_GOOD,
    STATUS_UNCERTAIN,
    NodeReading,
    exact,
    words,
)
from loopwright.serving.operating import allowed
from loopwright.serving.words import first_line

NO_LEASE_NOTE = (
    "there is none, so a loop on another machine that writes the same MVs is not found: have the server hold a text "
    f"{NAME} beside them that this user may write, or name one by nodes.lease"
)
MAY = {True: "yes", False: "no", None: "?"}


@dataclass(frozen=True, slots=True)
class Found:
    """One node. ``wrong`` says what would stop the loop, ``note`` what a person should know; empty: nothing.

    ``passing``: what is wrong may pass by itself, as a sensor's bad quality does.
    """

    signal: str
    node: str
    kind: str = "-"
    value: str = "-"
    unit: str = "-"
    quality: str = "-"
    age: str = "-"
    limits: str = "-"
    writable: str = "-"
    wrong: str = ""
    note: str = ""
    passing: bool = False
    written: bool = False  # by the loop


class _Asked(NamedTuple):
    """The server's answers about one node."""

    at: ua.NodeId
    reading: NodeReading
    writable: bool | None  # by this user; None: the server does not say
    plate: Plate


@dataclass(frozen=True, slots=True)
class Inspection:
    """A row for every node, and what the connection is to."""

    rows: list[Found]
    identity: Identity

    def lasting(self, *, writes: bool) -> list[str]:
        """A line for all that would stop the loop for good; ``writes``: whether it is to write at once."""
        wrong = [row for row in self.rows if row.wrong and not row.passing]
        return [f"{row.signal}: {row.wrong}" for row in wrong if writes or not row.written]


def inspected(
    manifest: Manifest, server: Server, nodes: Nodes, margin: float, spaces: Mapping[int, str] | None = None
) -> Inspection:
    """A row for every node, and for each namespace that is used by its number.

    ``margin`` is the share of a PV's range by which the loop's guards let it exceed that range; ``spaces`` are the
    namespaces by number that the loop found when it last ran. Raises EndpointError where the server cannot be asked
    now, LoopError where the settings do not fit.
    """
    nodes.check(manifest)
    return asyncio.run(_inspected(manifest, server, nodes, margin, spaces or {}))


async def _inspected(
    manifest: Manifest, server: Server, nodes: Nodes, margin: float, spaces: Mapping[int, str]
) -> Inspection:
    link = await Link.opened(server)
    try:
        plan = NodePlan(nodes, manifest)
        # A watchdog that cannot be read counts as dead, though no sample is judged by its quality.
        read = [replace(row, judged=row.judged or row.role is Role.WATCHDOG) for row in plan.rows]
        rows = [*read, *plan.outputs, *plan.extra]
        several = ""
        try:
            lease = await _lease_of(link, server, nodes)
        except SeveralLeasesError as error:
            lease, several = "", first_line(error)
        asked = await _asked(link, server, [row.node for row in rows] + ([lease] if lease else []))
        said = {row.title: nodes.local[row.signal.name] for row in rows if row.role is Role.LOCAL and row.signal}
        found = [_one(server, row, asked[row.node], margin, said.get(row.title)) for row in rows]
        back = nodes.hand_back
        if back is not None and not found[-1].wrong:
            found[-1] = replace(found[-1], wrong=_unfit(back.value, found[-1].kind))
        if several:
            found.append(Found("lease, written", "-", wrong=several, written=True))
        elif lease:
            found.append(_lease(lease, asked[lease]))
        else:
            found.append(Found("lease", "-", note="" if nodes.lease == NO_LEASE else NO_LEASE_NOTE))
        targets = [(row, a.at) for row in rows if row.written and isinstance(a := asked[row.node], _Asked)]
        if lease and isinstance(at := asked[lease], _Asked):
            targets.append((Row(Role.LEASE, Point(lease), written=True), at.at))
        shared = shared_node([row for row, _ in targets], [at for _, at in targets])
        found += [Found("nodes, written", "-", wrong=shared, written=True)] if shared else []
        found += _namespaces(nodes, await link.namespaces(server.connect_s), spaces)
        try:
            known = await identity(link, nodes, await link.started_s(server.connect_s), server.connect_s)
        except EndpointError:  # an id that is none, which its own row says
            known = Identity({}, {})
        if not known.writes:
            note = (
                "the server does not tell its name or its start: a loop that spells its address otherwise is not found"
            )
            found.append(Found("locks", "-", note=note))
        return Inspection([*found, *_certificates(link, server)], known)
    finally:
        await link.close()


async def _asked(link: Link, server: Server, nodes: list[str]) -> dict[str, _Asked | str]:
    """The server's answers about each node, read all at once as each scan does; of an id that is none, why."""
    ids: dict[str, ua.NodeId] = {}
    found: dict[str, _Asked | str] = {}
    for node in nodes:
        try:
            (ids[node],) = await link.resolved([node], server.connect_s)
        except EndpointError as error:
            found[node] = first_line(error)
    at = list(ids.values())
    readings = await link.read(at, server.connect_s)
    access = await link.values(at, server.connect_s, ua.AttributeIds.UserAccessLevel)
    told = await plates(link, at, server.connect_s)
    for node, reading, may, plate in zip(ids, readings, access, told, strict=True):
        level = None if may.Value is None else may.Value.Value
        found[node] = _Asked(ids[node], reading, bool(level & WRITABLE) if isinstance(level, int) else None, plate)
    return found


def _namespaces(nodes: Nodes, now: list[str], before: Mapping[int, str]) -> list[Found]:
    """The namespace of each number in the ids: it is another one once the server numbers them otherwise."""
    found = []
    for number, text in sorted(numbers(nodes.ids()).items()):
        uri, name = uri_of(now, number), f"namespace {number}"
        if before.get(number, uri) != uri:
            found.append(Found(name, uri or "-", wrong=renumbered(number, text, before[number], now)))
        elif uri:
            note = f"it is {uri} now; write {by_name(text, uri)}, which stays right when the server numbers otherwise"
            found.append(Found(name, uri, note=note))
        else:
            found.append(Found(name, "-", note="the server does not say what it is: no loop knows if it changes"))
    return found


def _certificates(link: Link, server: Server) -> list[Found]:
    """Until when both sides may speak."""
    if server.security == "None" or server.certificate is None:
        return []
    rows = [Found("certificate of this loop", "-", note=f"valid until {valid_until(server.certificate)}")]
    if server.user_certificate is not None:
        note = f"valid until {valid_until(server.user_certificate)}"
        rows.append(Found("certificate of the user", "-", note=note))
    own = link.server_certificate()
    if own:
        rows.append(Found("certificate of the server", "-", note=f"valid until {last_day(own)}"))
    return rows


async def _lease_of(link: Link, server: Server, nodes: Nodes) -> str:
    """The lease's node: that of the settings, or the one that is found beside the MVs; empty: there is none."""
    if nodes.lease:
        return "" if nodes.lease == NO_LEASE else nodes.lease
    with suppress(EndpointError):  # an id that is none, which its own row says
        written = await link.resolved([p.node for p in nodes.points("mv").values()], server.connect_s)
        at = await beside(link, written, server.connect_s)
        if at is not None:
            return whole(at, await link.namespaces(server.connect_s))
    return ""


def _lease(node: str, asked: _Asked | str) -> Found:
    """The text node by which loops on different machines find each other: without it no MV is written."""
    name = "lease, written"
    if isinstance(asked, str):
        return Found(name, node, wrong=asked, written=True)
    reading, writable = asked.reading, asked.writable
    kind = reading.kind.name if reading.kind is not None else "-"
    wrong = ""
    if reading.quality == STATUS_BAD:
        wrong = _bad(reading, node)
    elif reading.kind is not ua.VariantType.String:
        wrong = f"its type {kind} holds no text; it must be a String"
    elif writable is False:
        wrong = "it may not be written by this user"
    owner = reading.words_held.partition(" ")[0]
    note = f"{owner} has the plant, or had it last" if owner else ""
    quality = "Good" if reading.quality == STATUS_GOOD else words(reading.status)
    return Found(
        name, node, kind, owner or "-", quality=quality, writable=MAY[writable], wrong=wrong, note=note, written=True
    )


def _bad(reading: NodeReading, node: str) -> str:
    unknown = words(reading.status) == "BadNodeIdUnknown"
    return f"its quality is {words(reading.status)}" + (f"; the server has no node {node}" if unknown else "")


def _unfit(value: float, kind: str) -> str:
    """Why a number cannot be written into a node of a type, by the type's name; empty: it can."""
    try:
        exact(value, ua.VariantType[kind])
    except EndpointError as error:
        return f"value is {value:g}; {first_line(error)}"
    return ""


def _refused(row: Row, signal: Signal, number: float, margin: float) -> str:
    """Why a guard of the loop refuses a number; empty where none does: only PVs and the MVs read back have one."""
    values = np.array([number])
    if row.role is Role.PV:
        refusal = InRange((signal,), margin).check(Sample(values), ())
    elif row.role is Role.MV and not row.written:
        refusal = implausible((signal,), [number])
    else:
        refusal = None
    return "" if refusal is None else _outside(signal, number)


def _outside(signal: Signal, number: float) -> str:
    if signal.low <= number <= signal.high:
        return f"{number:.6g} {signal.unit} is no value that it may have" if signal.values is not None else ""
    return f"{number:.6g} lies outside {signal.low:g} .. {signal.high:g} {signal.unit}; another unit?"


def _one(server: Server, row: Row, asked: _Asked | str, margin: float, local: LocalNode | None = None) -> Found:
    name, node, point, signal = row.name, row.node, row.point, row.signal
    if isinstance(asked, str):
        return Found(name, node, wrong=asked, written=row.written)
    _, reading, writable, (unit, limits) = asked
    kind = reading.kind.name if reading.kind is not None else "-"
    number = point.scale * reading.number + point.offset
    age = "-" if reading.source_s is None else f"{time.time() - reading.source_s:.3g} s"
    wrong, passing = "", False
    if reading.quality == STATUS_BAD or (reading.quality == STATUS_UNCERTAIN and server.uncertain == "fault"):
        wrong, passing = _bad(reading, node), words(reading.status) != "BadNodeIdUnknown"
    elif reading.text:
        wrong, passing = f"it holds {reading.text}", reading.text in NO_NUMBERS
    elif row.written and reading.kind not in {*FLOATS, *INTEGERS, ua.VariantType.Boolean}:
        wrong = f"its type {kind} holds no number"
    elif row.written and writable is False:
        wrong = "it may not be written by this user"
    elif signal is not None:
        wrong, passing = _refused(row, signal, number, margin), True
    note = _no_value(row, number) if not reading.text else ""
    if signal is not None:
        outside = "" if wrong or reading.text else _outside(signal, number)
        misfit = other_unit(unit, point, signal)
        wrong, passing = (misfit, False) if misfit else (wrong, passing)
        note = "; ".join(filter(None, (outside, _other_range(limits, point, signal))))
    quality = "Good" if reading.quality == STATUS_GOOD else words(reading.status)
    if not row.judged:
        wrong, note = "", "; ".join(filter(None, (wrong, note)))
    shown = "-" if reading.text else f"{number:.6g}"
    if row.role is Role.LOCAL and local is not None and reading.quality != STATUS_BAD:
        shown = reading.words_held or shown
        has = local.plants(reading.number, reading.words_held) if shown != "-" else None
        note = {None: note or wrong, True: "the plant has this MV now", False: "this loop has it"}[has]
        wrong = ""
    return Found(name, node, kind, shown, unit, quality, age, limits, MAY[writable], wrong, note, passing, row.written)


def _no_value(row: Row, number: float) -> str:
    """Why a node's number is no value of ``operate``; it is no request then, and stops nothing. Empty: it is one."""
    e = row.entry
    if e is None or (e.low <= number <= e.high and (e.what not in SWITCHES or number in (0.0, 1.0))):
        return ""
    return f"{number:.6g} is none that it may have; allowed is {allowed(e)}"


def _other_range(limits: str, point: Point, signal: Signal) -> str:
    own = f"{signal.low:g} .. {signal.high:g}"
    if limits in {"-", own} or (point.scale, point.offset) != (1.0, 0.0):
        return ""
    return f"the controller's range is {own}"
