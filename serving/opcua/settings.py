"""Settings of an endpoint: the server, how to speak to it, and the node of every signal."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass, field
from math import isfinite
from pathlib import Path
from typing import Literal, TypeAlias

from loopwright.serving.errors import LoopError
from loopwright.serving.fields import nearest
from loopwright.serving.manifest import Manifest, OperateEntry, Signal

Group: TypeAlias = Literal["pv", "dv", "mv", "sp", "operate"]
NO_LEASE = "none"  # nodes.lease: none is looked for


@dataclass(frozen=True, slots=True)
class Point:
    """A node, and how its number becomes the signal's: value = scale raw + offset, in the signal's unit.

    ``node`` is a node id with its namespace's own name (``nsu=urn:plant;s=TIC101.PV``). An id with the namespace's
    number (``ns=2;s=TIC101.PV``) is another node once the server numbers its namespaces otherwise: the loop then holds
    until the id is written by name. `loop check` says which name each number has now. ``read_back``, of an MV alone,
    is the node of what the actuator really has; empty: ``node`` itself. ``unit`` is the server's name of the unit,
    where it is another name of the controller's unit, or ``scale`` and ``offset`` convert it.
    """

    node: str
    scale: float = 1.0
    offset: float = 0.0
    read_back: str = ""
    unit: str = ""

    def __post_init__(self) -> None:
        if not self.node:
            raise LoopError("node is empty; it needs a node id such as 'nsu=urn:plant;s=TIC101.PV'")
        if not (isfinite(self.scale) and self.scale != 0 and isfinite(self.offset)):
            raise LoopError(f"scale is {self.scale} and offset {self.offset}; scale must not be 0, both finite")


@dataclass(frozen=True, slots=True)
class ModeNode:
    """A node by which the plant's own operator sets the mode: the number of each mode that it can ask for."""

    node: str
    values: Mapping[str, float]

    def __post_init__(self) -> None:
        unknown = [m for m in self.values if m not in {"MANUAL", "AUTO", "SHADOW", "HOLD"}]
        if unknown or len(set(self.values.values())) < len(self.values):
            raise LoopError(
                f"values is {dict(self.values)}; it needs a number of its own for one or more of MANUAL, AUTO, SHADOW, "
                "HOLD"
            )


@dataclass(frozen=True, slots=True)
class LocalNode:
    """A node that says whether the plant has an MV itself, by numbers or texts.

    ``node`` is its id. The plant has the MV at one of the values ``local``, or at any value that is none of ``remote``:
    one of both is given.
    """

    node: str
    local: tuple[float | bool | str, ...] = ()
    remote: tuple[float | bool | str, ...] = ()

    def __post_init__(self) -> None:
        if not self.node:
            raise LoopError("node is empty; it needs a node id such as 'nsu=urn:plant;s=FIC101.MODE'")
        if bool(self.local) == bool(self.remote):
            raise LoopError(
                'either `local` lists the values at which the plant has the MV, as ["MAN"] or [0], or `remote` those '
                "at which this loop has it"
            )

    def plants(self, number: float, text: str) -> bool:
        """Whether the plant has the MV where the node holds this number (NaN: none) or this text (empty: none)."""
        listed = self.local or self.remote
        named = any(isinstance(v, str) and v.strip().casefold() == text.strip().casefold() for v in listed)
        found = named or any(not isinstance(v, str) and float(v) == number for v in listed)
        return found == bool(self.local)


@dataclass(frozen=True, slots=True)
class AnalyserNode:
    """The way in which an analyser's new results are told from one that stands.

    ``longest_s`` is the longest time [s] without a new one. A result is ``new`` where its ``number`` is another one;
    with ``source_time`` also where its source time is, which tells two equal results apart. It suits a server that
    stamps a value when it is made: one that stamps what stands anew would make each reading a result.
    """

    longest_s: float
    new: Literal["number", "source_time"] = "number"

    def __post_init__(self) -> None:
        if not (isfinite(self.longest_s) and self.longest_s > 0):
            raise LoopError(
                f"nodes.analysers: longest_s is {self.longest_s:g}; it needs the longest time in seconds, above 0"
            )


@dataclass(frozen=True, slots=True)
class HandBack:
    """The node by which the plant's own controller takes the plant, and the number that asks it to."""

    node: str
    value: float


@dataclass(frozen=True, slots=True)
class Nodes:
    """The node of each signal by its name, and of what else the two sides tell each other.

    ``heartbeat`` counts the loop's scans. ``watchdog`` is a number that the server's side changes while it lives; it
    counts as dead after ``watchdog_scans`` scans without a change. ``lease`` is a text that holds who controls this
    plant. Without it a node LoopwrightLease is the lease that lies beside those of the MVs; "none": there is no lease.
    ``operate`` has nodes by which the plant's own operator changes values of the law's ``operate``, each by its name,
    ``local`` those that say whether the plant has an MV itself. ``analysers`` are process variables whose number stands
    between two results: each with the longest time [s] without a new one, or a table that also says how a new one is
    told.
    """

    pv: Mapping[str, str | Point]
    mv: Mapping[str, str | Point]
    dv: Mapping[str, str | Point] = field(default_factory=dict)
    sp: Mapping[str, str | Point] = field(default_factory=dict)
    operate: Mapping[str, str | Point] = field(default_factory=dict)
    local: Mapping[str, LocalNode] = field(default_factory=dict)
    analysers: Mapping[str, float | AnalyserNode] = field(default_factory=dict)
    mode: ModeNode | None = None
    heartbeat: str = ""
    watchdog: str = ""
    watchdog_scans: int = 3
    lease: str = ""
    hand_back: HandBack | None = None

    def __post_init__(self) -> None:
        if self.watchdog_scans < 1:
            raise LoopError(f"watchdog_scans is {self.watchdog_scans}; it must be at least 1")

    def points(self, name: Group) -> dict[str, Point]:
        """The points of one group by signal name, those of ``operate`` by its entries'."""
        return {n: Point(p) if isinstance(p, str) else p for n, p in getattr(self, name).items()}

    def results(self) -> dict[str, AnalyserNode]:
        """The analysers by the name of their PV; LoopError for a longest time that is none."""
        return {n: of if isinstance(of, AnalyserNode) else AnalyserNode(of) for n, of in self.analysers.items()}

    def ids(self) -> list[str]:
        """Every node id that is given, as it is written."""
        groups: tuple[Group, ...] = ("pv", "dv", "mv", "sp", "operate")
        points = [p for name in groups for p in self.points(name).values()]
        others = [p.node for p in (self.mode, self.hand_back, *self.local.values()) if p is not None]
        texts = [*(t for p in points for t in (p.node, p.read_back)), *others]
        return [t for t in [*texts, self.heartbeat, self.watchdog, self.lease] if t and t != NO_LEASE]

    def check(self, manifest: Manifest) -> None:
        """LoopError where a signal that the law needs has no node, or a node no signal."""
        groups: tuple[tuple[Group, tuple[Signal | OperateEntry, ...]], ...] = (
            ("pv", manifest.pv), ("mv", manifest.mv), ("dv", manifest.dv), ("sp", manifest.sp),
            ("operate", manifest.operate),
        )  # fmt: skip
        for name, entries in groups:
            points, known = self.points(name), [s.name for s in entries]
            for given in points:
                if given not in known:
                    raise LoopError(f"nodes.{name} has {given!r}, which the controller has not{nearest(given, known)}")
            missing = [s for s in known if s not in points]
            if missing and (name in {"pv", "mv"} or (name == "dv" and "dv" in manifest.inputs)):
                raise LoopError(f"nodes.{name} lacks {', '.join(missing)}; give each a node id")
            if name != "mv" and any(p.read_back for p in points.values()):
                raise LoopError(f"nodes.{name} has a read_back, which only an MV has")
        pvs = [s.name for s in manifest.pv]
        for given in self.results():
            if given not in pvs:
                raise LoopError(f"nodes.analysers has {given!r}, which is no PV{nearest(given, pvs)}")
        if self.analysers and "fresh" not in manifest.inputs:
            raise LoopError(
                f"nodes.analysers: {manifest.law} takes each number for a new reading; design it with `operate: {{}}`"
            )
        able = [e.signal for e in manifest.operate if e.group == "mv" and e.what == "use"]
        for given in self.local:
            if given not in able:
                raise LoopError(
                    f"nodes.local has {given!r}, an MV without which the law cannot do{nearest(given, able)}"
                )


@dataclass(frozen=True, slots=True)
class Server:
    """How to reach a server, and what to believe of it.

    ``security`` is signed and encrypted by ``certificate`` and ``private_key``; the policy None is refused unless
    ``insecure``. ``server_certificate`` pins the server's own. The loop logs on as ``user``, whose password comes from
    the environment variable ``password_env`` or from ``password_file``, or by a certificate of a user's own,
    ``user_certificate`` with ``user_key``, or as nobody. ``uncertain`` says whether a value of uncertain quality is
    used. ``source_time`` says whether a value whose source time stands still grows old: ``ignore`` it for a server
    that stamps a value only when it changes. An MV that has not changed is written again after ``rewrite_s`` [s]; 0:
    at every scan.
    """

    endpoint: str
    security: Literal["Basic256Sha256", "Aes128Sha256RsaOaep", "Aes256Sha256RsaPss", "None"] = "Basic256Sha256"
    insecure: bool = False
    certificate: Path | None = None
    private_key: Path | None = None
    server_certificate: Path | None = None
    user: str = ""
    password_env: str = ""
    password_file: Path | None = None
    user_certificate: Path | None = None
    user_key: Path | None = None
    connect_s: float = 5.0
    uncertain: Literal["fault", "use"] = "fault"
    source_time: Literal["judge", "ignore"] = "judge"
    rewrite_s: float = 0.0

    def __post_init__(self) -> None:
        if not self.endpoint.startswith("opc.tcp://"):
            raise LoopError(f"endpoint is {self.endpoint!r}; it must begin with opc.tcp://")
        if "@" in self.endpoint:
            raise LoopError("endpoint holds a user name; give it as user, its password by password_env")
        if self.security == "None" and not self.insecure:
            raise LoopError(
                "security is None: everyone on the network could read and change what is sent. Use Basic256Sha256, or "
                "say insecure = true"
            )
        if self.security != "None" and (self.certificate is None or self.private_key is None):
            raise LoopError(
                f"security {self.security} needs certificate and private_key; `loopwright loop init` makes them"
            )
        if self.password_env and self.password_file is not None:
            raise LoopError("give password_env or password_file, not both")
        if self.user and not (self.password_env or self.password_file is not None):
            raise LoopError("user needs a password: name an environment variable (password_env) or a file")
        if (self.user_certificate is None) != (self.user_key is None):
            raise LoopError("a user's certificate needs its key: give both user_certificate and user_key")
        if self.user_certificate is not None and self.user:
            raise LoopError("give user or user_certificate, not both: a session has one user")
        if self.user_certificate is not None and self.security == "None":
            raise LoopError("user_certificate needs a connection that is signed and encrypted; security is None")
        if not (isfinite(self.connect_s) and self.connect_s > 0):
            raise LoopError(f"connect_s is {self.connect_s}; it must be above zero")
        if not (isfinite(self.rewrite_s) and self.rewrite_s >= 0):
            raise LoopError(f"rewrite_s is {self.rewrite_s}; it must be 0 (at every scan) or more")

    def password(self) -> str:
        """The password; empty without a user. LoopError where it is not to be had."""
        if not self.user:
            return ""
        if self.password_file is not None:
            try:
                return self.password_file.read_text(encoding="utf-8").strip()
            except OSError as error:
                raise LoopError(f"password_file cannot be read: {error.strerror}: {self.password_file}") from None
        found = os.environ.get(self.password_env)
        if not found:
            raise LoopError(f"the environment variable {self.password_env}, which holds the password, is not set")
        return found
