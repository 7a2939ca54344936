"""Bugs put into a station's parts on purpose: histories of a world must find each."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from loopwright.serving.journal import Journal
from loopwright.serving.journal.waiting import EntryQueue
from loopwright.serving.opcua.endpoint import OpcUaEndpoint
from loopwright.serving.opcua.mv_sender import MvSender
from loopwright.serving.opcua.node_lease import NodeLease
from loopwright.serving.station.recorder import Recorder
from world.planted import Planted, put_in


def _seen(self: NodeLease, text: str) -> None:
    self._still = self._still + 1 if text == self._text else 0
    self._text = text


def _note_no_end(note: Any) -> Any:
    def act(self: Recorder, kind: Any, who: str, what: str, reason: str = "", **named: Any) -> None:
        if named.get("alarm") == "fault" and not named.get("raised", False):
            named["alarm"] = ""
        note(self, kind, who, what, reason, **named)

    return act


def _scan_of_good(scan: Any) -> Any:
    def act(self: Journal, entry: Any) -> None:
        if not entry.reason:
            scan(self, entry)

    return act


def _late(stands: Any) -> Any:
    def act(self: MvSender, mv: Any, mine: bool) -> Any:
        held = self.__dict__.setdefault("held", [])
        held.append(mv.copy())
        mv[:] = held[max(0, len(held) - 11)]
        return stands(self, mv, mine)

    return act


def _give_back(self: EntryQueue, most: int) -> None:
    self._taken = []


async def _rests_on(self: OpcUaEndpoint, seconds: float, rest: Any = OpcUaEndpoint._rest) -> None:
    await rest(self, 20_000.0 * seconds)


def _young(read: Any) -> Any:
    def act(self: OpcUaEndpoint) -> Any:
        if self.values is not None:
            self.trouble = self._read_failure = ""
            self._given = None
            self.max_age_s = 1e9
            self.values = replace(self.values, arrived_s=self.clock())
        return read(self)

    return act


PLANTED_STATIONS: dict[str, Planted] = {
    "a lease that another loop has taken counts as held": put_in(NodeLease, "seen", _seen),
    "an MV goes out though the one before it was refused meanwhile": put_in(MvSender, "doubted", False),
    "the alarm of a fault has no end": put_in(Recorder, "note", _note_no_end(Recorder.note)),
    "what the disk does not take is forgotten": put_in(EntryQueue, "give_back", _give_back),
    "a connection is made anew after hours": put_in(OpcUaEndpoint, "_rest", _rests_on),
    "values of long ago are as young as any": put_in(OpcUaEndpoint, "read", _young(OpcUaEndpoint.read)),
    "an MV goes out ten scans late": put_in(MvSender, "stands", _late(MvSender.stands)),
    "no scan is written down while a fault lasts": put_in(Journal, "scan", _scan_of_good(Journal.scan)),
}
