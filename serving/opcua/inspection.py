"""Every node of a loop, read once: what is there, and what would stop the loop."""

from __future__ import annotations

import asyncio
import time
from dataclasses import dataclass, replace

import numpy as np
from asyncua import ua

from serving.errors import EndpointError
from serving.guard import InRange, Sample, implausible
from serving.manifest import Manifest, Signal
from serving.opcua.certificates import last_day, valid_until
from serving.opcua.link import Link
from serving.opcua.plan import Plan
from serving.opcua.sampling import NO_NUMBERS
from serving.opcua.settings import Nodes, Point, Server
from serving.opcua.values import BAD, FLOATS, GOOD, INTEGERS, UNCERTAIN, Reading, exact, words
from serving.words import first_line

WRITABLE = 2  # the second bit of an access level
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


def lasting(manifest: Manifest, server: Server, nodes: Nodes, margin: float, *, writes: bool) -> list[str]:
    """A line for all that would stop the loop and does not pass by itself; ``writes``: whether it is to write at once.

    Raises EndpointError where the server cannot be asked now, LoopError where the settings do not fit.
    """
    rows = inspected(manifest, server, nodes, margin)
    wrong = [row for row in rows if row.wrong and not row.passing]
    return [f"{row.signal}: {row.wrong}" for row in wrong if writes or not row.signal.endswith(", written")]


def inspected(manifest: Manifest, server: Server, nodes: Nodes, margin: float) -> list[Found]:
    """A row for every node, and one for the connection. Raises LoopError where the settings do not fit.

    ``margin`` is the share of a PV's range by which the loop's guards let it exceed that range.
    """
    nodes.check(manifest)
    return asyncio.run(_inspected(manifest, server, nodes, margin))


async def _inspected(manifest: Manifest, server: Server, nodes: Nodes, margin: float) -> list[Found]:
    link = await Link.opened(server)
    try:
        plan = Plan(nodes, manifest)
        # A watchdog that cannot be read counts as dead, though no sample is judged by its quality.
        rows = [(name, p.read_back or p.node, p, judged or name == "watchdog") for name, p, judged in plan.points]
        rows += [(f"MV {s.name}, written", p.node, p, True) for s, p in zip(manifest.mv, plan.mv_points, strict=True)]
        found = []
        for name, node, point, judged in rows:
            found.append(await _one(link, manifest, server, name, node, point, judged, margin))
        if nodes.heartbeat:
            at = nodes.heartbeat
            found.append(await _one(link, manifest, server, "heartbeat, written", at, Point(at), True, margin))
        if nodes.hand_back is not None:
            at, value = nodes.hand_back.node, nodes.hand_back.value
            row = await _one(link, manifest, server, "hand_back, written", at, Point(at), True, margin)
            found.append(row if row.wrong else replace(row, wrong=_unfit(value, row.kind)))
        if nodes.lease:
            found.append(await _lease(link, server, nodes.lease))
        return [*found, *_certificates(link, server)]
    finally:
        await link.close()


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


async def _lease(link: Link, server: Server, node: str) -> Found:
    """The text node by which loops on different machines find each other: without it no MV is written."""
    name = "lease, written"
    try:
        reading, writable = await _read(link, server, node)
    except EndpointError as error:
        return Found(name, node, wrong=first_line(error))
    kind = reading.kind.name if reading.kind is not None else "-"
    wrong = ""
    if reading.quality == BAD:
        wrong = _bad(reading, node)
    elif reading.kind is not ua.VariantType.String:
        wrong = f"its type {kind} holds no text; it must be a String"
    elif writable is False:
        wrong = "it may not be written by this user"
    owner = reading.words_held.partition(" ")[0]
    note = f"{owner} has the plant, or had it last" if owner else ""
    quality = "Good" if reading.quality == GOOD else words(reading.status)
    return Found(name, node, kind, owner or "-", quality=quality, writable=MAY[writable], wrong=wrong, note=note)


async def _read(link: Link, server: Server, node: str) -> tuple[Reading, bool | None]:
    """What a node holds, and whether this user may write it; None: the server does not say."""
    (at,) = await link.resolved([node], server.connect_s)
    (reading,) = await link.read([at], server.connect_s)
    (access,) = await link.values([at], server.connect_s, ua.AttributeIds.UserAccessLevel)
    level = access.Value.Value if access.Value is not None else None
    return reading, bool(level & WRITABLE) if isinstance(level, int) else None


def _bad(reading: Reading, node: str) -> str:
    unknown = words(reading.status) == "BadNodeIdUnknown"
    return f"its quality is {words(reading.status)}" + (f"; the server has no node {node}" if unknown else "")


def _unfit(value: float, kind: str) -> str:
    """Why a number cannot be written into a node of a type, by the type's name; empty: it can."""
    try:
        exact(value, ua.VariantType[kind])
    except EndpointError as error:
        return f"value is {value:g}; {first_line(error)}"
    return ""


def _refused(name: str, signal: Signal, number: float, margin: float) -> str:
    """Why a guard of the loop refuses a number; empty where none does: only PVs and the MVs read back have one."""
    values = np.array([number])
    if name.startswith("PV "):
        refusal = InRange((signal,), margin).check(Sample(values), ())
    elif name.startswith("MV ") and not name.endswith(", written"):
        refusal = implausible((signal,), [number])
    else:
        refusal = None
    return "" if refusal is None else _outside(signal, number)


def _outside(signal: Signal, number: float) -> str:
    if signal.low <= number <= signal.high:
        return f"{number:.6g} {signal.unit} is no value that it may have" if signal.values is not None else ""
    return f"{number:.6g} lies outside {signal.low:g} .. {signal.high:g} {signal.unit}; another unit?"


async def _one(
    link: Link, manifest: Manifest, server: Server, name: str, node: str, point: Point, judged: bool, margin: float
) -> Found:
    try:
        (at,) = await link.resolved([node], server.connect_s)
        reading, writable = await _read(link, server, node)
    except EndpointError as error:
        return Found(name, node, wrong=first_line(error))
    kind = reading.kind.name if reading.kind is not None else "-"
    number = point.scale * reading.number + point.offset
    age = "-" if reading.source_s is None else f"{time.time() - reading.source_s:.3g} s"
    signal = _signal(manifest, name)
    wrong, passing = "", False
    if reading.quality == BAD or (reading.quality == UNCERTAIN and server.uncertain == "fault"):
        wrong, passing = _bad(reading, node), words(reading.status) != "BadNodeIdUnknown"
    elif reading.text:
        wrong, passing = f"it holds {reading.text}", reading.text in NO_NUMBERS
    elif name.endswith(", written") and reading.kind not in {*FLOATS, *INTEGERS, ua.VariantType.Boolean}:
        wrong = f"its type {kind} holds no number"
    elif name.endswith(", written") and writable is False:
        wrong = "it may not be written by this user"
    elif signal is not None:
        wrong, passing = _refused(name, signal, number, margin), True
    unit, limits = await _properties(link, server, at)
    note = ""
    if signal is not None:
        outside = "" if wrong or reading.text else _outside(signal, number)
        misfit = other_unit(unit, point, signal)
        wrong, passing = (misfit, False) if misfit else (wrong, passing)
        note = "; ".join(filter(None, (outside, _other_range(limits, point, signal))))
    quality = "Good" if reading.quality == GOOD else words(reading.status)
    if not judged:
        wrong, note = "", "; ".join(filter(None, (wrong, note)))
    shown = "-" if reading.text else f"{number:.6g}"
    return Found(name, node, kind, shown, unit, quality, age, limits, MAY[writable], wrong, note, passing)


def _signal(manifest: Manifest, name: str) -> Signal | None:
    group, _, rest = name.partition(" ")
    rest = rest.removesuffix(", written")
    signals = {"PV": manifest.pv, "MV": manifest.mv, "DV": manifest.dv, "SP": manifest.sp}.get(group, ())
    return next((s for s in signals if s.name == rest), None)


async def _properties(link: Link, server: Server, at: ua.NodeId) -> tuple[str, str]:
    """(unit, range) as the server tells them; "-" where it does not."""
    unit = limits = "-"
    try:
        node = link.client.get_node(at)
        async with asyncio.timeout(server.connect_s):
            for child in await node.get_properties():
                name = (await child.read_browse_name()).Name
                if name == "EngineeringUnits":
                    unit = (await child.read_value()).DisplayName.Text or "-"
                elif name == "EURange":
                    value = await child.read_value()
                    limits = f"{value.Low:g} .. {value.High:g}"
    except Exception:  # properties are a courtesy of the server
        return unit, limits
    return unit, limits


def other_unit(unit: str, point: Point, signal: Signal) -> str:
    """What is wrong with the server's unit of a signal; empty where loop.toml explains it."""
    converted = (point.scale, point.offset) != (1.0, 0.0)
    if unit in {"-", point.unit} or (not point.unit and (converted or unit == signal.unit)):
        return ""
    if point.unit:
        return f"the server says the unit is {unit}, loop.toml says {point.unit}"
    return (
        f"the server says the unit is {unit}, the controller's is {signal.unit}: give scale and offset, or "
        f'unit = "{unit}" where it is only another name'
    )


def _other_range(limits: str, point: Point, signal: Signal) -> str:
    own = f"{signal.low:g} .. {signal.high:g}"
    if limits in {"-", own} or (point.scale, point.offset) != (1.0, 0.0):
        return ""
    return f"the controller's range is {own}"
