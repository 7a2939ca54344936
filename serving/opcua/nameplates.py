"""The identity of a loop's nodes: namespace, type, unit and range, held against what a run's first connection found.

A server that was started anew may number its namespaces otherwise, and an engineer may change a node under a loop that
runs: the same id then means another signal, or another number. Neither is believed.
"""

from __future__ import annotations

import asyncio
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from types import MappingProxyType
from typing import NamedTuple

from asyncua import ua

from loopwright.serving.errors import EndpointError
from loopwright.serving.guard import Fault
from loopwright.serving.manifest import Manifest, Signal
from loopwright.serving.opcua.link import Link, node_id
from loopwright.serving.opcua.plan import NodePlan, Role, Row
from loopwright.serving.opcua.settings import Nodes, Point
from loopwright.serving.opcua.values import FLOATS, INTEGERS, unanswered

# between two looks at what may change without a new connection; while something is wrong
NAMEPLATE_LOOK_S, WRONG_S = 60.0, 2.0
UNKNOWN = "-"
NULL = ua.VariantType.Null
NUMBERS = {*FLOATS, *INTEGERS}
ANY = {ua.ObjectIds.BaseDataType, ua.ObjectIds.Number, ua.ObjectIds.Integer, ua.ObjectIds.UInteger}


class ChangedNodeError(EndpointError):
    """A node is another one than the loop began with: nothing is read or written there."""


class Plate(NamedTuple):
    """A node's unit and range as its server tells them; ``UNKNOWN`` where it does not."""

    unit: str = UNKNOWN
    limits: str = UNKNOWN


class KnownNode(NamedTuple):
    """A node as it was seen, by its id in loop.toml; UNKNOWN where its server did not tell."""

    node: str
    type: str
    unit: str
    range: str


class Identity(NamedTuple):
    """The other end of a connection: the URI of each namespace that is used by its number, and the nodes it may write.

    ``writes`` has each by a key that is the same however host and id are spelt; empty where a server tells too little.
    ``nodes`` has each by its id with its namespace's name, which is the same however the id is spelt. Both give the
    spelling of loop.toml. ``seen`` has by row what the loop began with.
    """

    spaces: Mapping[int, str]
    writes: Mapping[str, str]
    nodes: Mapping[str, str] = MappingProxyType({})
    seen: Mapping[str, KnownNode] = MappingProxyType({})


class Nameplates:
    """The nodes as they were when the loop began.

    ``fault`` says why a measured unit or range is another one now. ``unwritable`` says why that, or the type, of a node
    is which the loop writes: it refuses the MV, not the sample. ``wrong`` has a reason by row. Empty: all is as it was.
    A fault lasts until the node is read with what it had before: an answer that does not come, or tells nothing,
    ends nothing.

    Parameters
    ----------
    nodes, manifest
        Of the loop.
    spaces
        The namespaces by number that an earlier run found behind these ids.
    """

    def __init__(self, nodes: Nodes, manifest: Manifest, spaces: Mapping[int, str] | None = None) -> None:
        self.nodes, self.manifest = nodes, manifest
        self.spaces = {number: uri for number, uri in (spaces or {}).items() if uri}
        self.fault = self.unwritable = ""
        self.wrong: Mapping[str, str] = {}  # replaced as a whole: other threads read it
        self.moved: ChangedNodeError | None = None  # what ``watch`` has found
        self._kinds: dict[str, ua.VariantType] = {}
        self._plates: dict[str, Plate] = {}
        self._wrong: dict[tuple[Row, str], str] = {}  # why, by row and what of it is wrong
        self._any_number: set[str] = set()  # rows whose nodes are declared to hold numbers of any type

    async def require_spaces(self, link: Link, timeout_s: float, *, anew: bool = False) -> None:
        """ChangedNodeError where a number stands for another namespace now."""
        numbered = numbers(self.nodes.ids())
        if not numbered:
            return
        now = await link.namespaces(timeout_s, anew=anew)
        for number, text in numbered.items():
            before, uri = self.spaces.get(number), uri_of(now, number)
            if before and uri != before:
                raise ChangedNodeError(renumbered(number, text, before, now))
            if uri:
                self.spaces[number] = uri

    def typed(self, row: Row, kind: ua.VariantType | None) -> str:
        """Why a node's type is another one than the loop began with; empty where it is the same, or not known."""
        if kind in {None, NULL}:
            return ""
        assert kind is not None
        name = row.name
        before = self._kinds.setdefault(name, kind)
        if kind is before or (name in self._any_number and {kind, before} <= NUMBERS):
            return ""
        words = f"{name}: its type is {kind.name} now and was {before.name}; a restart of the loop accepts it"
        return Fault(words, "type", name)

    async def look(self, link: Link, plan: NodePlan, timeout_s: float) -> None:
        """See which unit, range and type each node has now; EndpointError where nobody answers."""
        rows = plan.measuring()
        nodes = [node for _, node in rows]
        found, kinds = await plates(link, nodes, timeout_s), await link.read(nodes, timeout_s)
        mode = [(row, at) for row, at in zip(plan.rows, plan.asked, strict=False) if row.role is Role.MODE]
        declared = await any_number(link, [node for _, node in [*rows, *mode]], timeout_s)
        for (row, _), free in zip([*rows, *mode], declared, strict=True):
            if free is not None:
                (self._any_number.add if free else self._any_number.discard)(row.name)
        for (row, _), plate, answer in zip(rows, found, kinds, strict=True):
            self._compare(row, plate)
            changed = self.typed(row, answer.kind)
            if row.written and answer.kind not in {None, NULL}:  # the others are judged at each reading
                self._judge(row, "type", changed)
        self.wrong = {row.name: why for (row, _), why in reversed(self._wrong.items())}
        self.fault = next((why for (row, _), why in self._wrong.items() if row.measured), "")
        self.unwritable = next((why for (row, _), why in self._wrong.items() if row.written), "")

    def seen(self, plan: NodePlan) -> dict[str, KnownNode]:
        """The nodes by row as they were when the loop began."""
        found = {}
        for row, _ in plan.measuring():
            kind, plate = self._kinds.get(row.name), self._plates.get(row.name, Plate())
            found[row.name] = KnownNode(row.node, UNKNOWN if kind is None else kind.name, *plate)
        return found

    async def watch(self, link: Link, plan: NodePlan, timeout_s: float) -> None:
        """Look again now and then, until a node is another one: ``moved`` then says so."""
        while True:
            await asyncio.sleep(WRONG_S if self.wrong else NAMEPLATE_LOOK_S)
            try:
                await self.again(link, plan, timeout_s)
            except ChangedNodeError as error:
                self.moved = error
                link.on_gone()
                return
            except EndpointError:  # the loop's own readings judge a server that is silent
                continue

    async def again(self, link: Link, plan: NodePlan, timeout_s: float) -> None:
        """All that may change without a new connection. ChangedNodeError, EndpointError."""
        await self.require_spaces(link, timeout_s, anew=True)
        await self.look(link, plan, timeout_s)

    def _compare(self, row: Row, now: Plate) -> None:
        """Begin or end the faults of a node's unit and range; what the server does not tell does neither."""
        before = self._plates.get(row.name, Plate())
        self._plates[row.name] = Plate(*(n if b == UNKNOWN else b for b, n in zip(before, now, strict=True)))
        for what, was, is_now in zip(("unit", "range"), before, now, strict=True):
            if is_now == UNKNOWN:
                continue
            judged = what == "unit" and row.role is not Role.SP
            misfit = other_unit(is_now, row.point, row.signal) if judged and row.signal is not None else ""
            if was not in {UNKNOWN, is_now}:
                misfit = f"its {what} is {is_now} now and was {was}; see `loop check`, and start the loop anew"
            self._judge(row, what, Fault(f"{row.name}: {misfit}", what, row.name) if misfit else "")

    def _judge(self, row: Row, what: str, why: str) -> None:
        """The fault of a row begins, lasts, or is over (empty)."""
        if why:
            self._wrong[row, what] = why
        else:
            self._wrong.pop((row, what), None)


def numbers(ids: Iterable[str]) -> dict[int, str]:
    """The namespaces that ids name by number, each with the first such id. Texts that are no ids are told elsewhere."""
    found: dict[int, str] = {}
    for text in ids:
        with suppress(EndpointError):
            number = 0 if text.startswith("nsu=") else int(node_id(text, []).NamespaceIndex)
            if number:
                found.setdefault(number, text)
    return found


def uri_of(spaces: Sequence[str], number: int) -> str:
    """A namespace's name by its number; empty where there is none."""
    return spaces[number] if number < len(spaces) else ""


def by_name(text: str, uri: str) -> str:
    """An id that names its namespace by number, with the namespace's own name."""
    return _named(node_id(text, []), uri)


def _named(node: ua.NodeId, uri: str) -> str:
    return f"nsu={uri};" + str(node.to_string()).removeprefix(f"ns={int(node.NamespaceIndex)};")


def renumbered(number: int, text: str, before: str, spaces: Sequence[str]) -> str:
    """The fault of a number that stands for another namespace than ``before`` in the server's ``spaces``."""
    if not spaces:
        return f"namespace {number} was {before}, and the server does not say what it is now; so {text} is not believed"
    now = uri_of(spaces, number)
    present = f"is {now} now and was {before}" if now else f"was {before} and is not there now"
    fault = f"namespace {number} {present}, so {text} would be another node"
    if before in spaces:
        return f"{fault}; write {by_name(text, before)} in loop.toml"
    if now:
        renamed = f"if {now} is the same plant under another name, write {by_name(text, now)} in loop.toml"
        return f"{fault}; the server has no namespace {before} any more: {renamed}"
    return f"{fault}; the server has the namespaces {', '.join(spaces)}"


async def identity(link: Link, nodes: Nodes, started_s: float | None, timeout_s: float) -> Identity:
    """The identity of the server, and the nodes that the loop writes, however they are spelt.

    Two servers may have one name, so a server is known by its name and the moment of its start. Its other namespaces
    are no part of that: it may add some while it runs.
    """
    spaces, texts = await link.namespaces(timeout_s), [p.node for p in nodes.points("mv").values()]
    found = {n: uri for n in numbers(nodes.ids()) if (uri := uri_of(spaces, n))}
    written = {whole(node_id(t, spaces), spaces): t for t in texts}
    name = await link.server_uri(timeout_s)
    if not name or started_s is None:
        return Identity(found, {}, written)
    return Identity(found, {f"{name} {started_s!r} {node}": t for node, t in written.items()}, written)


def whole(node: ua.NodeId, spaces: Sequence[str]) -> str:
    """A node's id with its namespace's name, or its number where a server does not tell the name."""
    number = int(node.NamespaceIndex)
    return _named(node, uri_of(spaces, number) or str(number))


async def plates(link: Link, nodes: Sequence[ua.NodeId], timeout_s: float) -> list[Plate]:
    """Unit and range of nodes, in two requests. They are a server's courtesy: UNKNOWN where it refuses to tell them.

    EndpointError where it does not answer: what it would have told may be another unit.
    """
    try:
        found = await link.browsed(nodes, ua.ObjectIds.HasProperty, timeout_s)
        asked = [
            (i, str(r.BrowseName.Name), r.NodeId)
            for i, rows in enumerate(found)
            for r in rows
            if r.BrowseName.Name in {"EngineeringUnits", "EURange"}
        ]
        answers = await link.values([ua.NodeId(n.Identifier, n.NamespaceIndex) for _, _, n in asked], timeout_s)
    except EndpointError as error:
        if unanswered(error, link.gone):
            raise
        return [Plate() for _ in nodes]
    told: list[dict[str, str]] = [{} for _ in nodes]
    for (i, name, _), answer in zip(asked, answers, strict=True):
        value = None if answer.Value is None else answer.Value.Value
        if name == "EURange" and isinstance(value, ua.Range):
            told[i]["limits"] = f"{value.Low:g} .. {value.High:g}"
        elif name == "EngineeringUnits" and isinstance(value, ua.EUInformation):
            told[i]["unit"] = value.DisplayName.Text or UNKNOWN
    return [Plate(**plate) for plate in told]


async def any_number(link: Link, nodes: Sequence[ua.NodeId], timeout_s: float) -> list[bool | None]:
    """Whether each node is declared to hold numbers of any type (Number, Integer, UInteger) or anything at all.

    None where the server does not tell. EndpointError where it does not answer.
    """
    try:
        answers = await link.values(nodes, timeout_s, ua.AttributeIds.DataType)
    except EndpointError as error:
        if unanswered(error, link.gone):
            raise
        return [None for _ in nodes]
    kinds = [None if a.Value is None else a.Value.Value for a in answers]
    return [(k.NamespaceIndex == 0 and k.Identifier in ANY) if isinstance(k, ua.NodeId) else None for k in kinds]


def others_since(before: Mapping[str, KnownNode], now: Mapping[str, KnownNode]) -> list[str]:
    """A line for each row whose node has another type, unit or range than before; one of another id is another node."""
    return [
        f"{row}: its {what} is {is_now} now and was {was} when the loop last ran"
        for row, seen in now.items()
        if row in before and before[row].node == seen.node
        for what, was, is_now in zip(KnownNode._fields[1:], before[row][1:], seen[1:], strict=True)
        if UNKNOWN not in {was, is_now} and was != is_now
    ]


def other_unit(unit: str, point: Point, signal: Signal) -> str:
    """The fault of the server's unit of a signal; empty where loop.toml explains it."""
    converted = (point.scale, point.offset) != (1.0, 0.0)
    if unit in {UNKNOWN, point.unit} or (not point.unit and (converted or unit == signal.unit)):
        return ""
    if point.unit:
        return f"the server says the unit is {unit}, loop.toml says {point.unit}"
    return (
        f"the server says the unit is {unit}, the controller's is {signal.unit}: give scale and offset, or "
        f'unit = "{unit}" where it is only another name'
    )
