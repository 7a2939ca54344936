"""loop.toml: everything that a running loop must be told, as frozen dataclasses."""

from __future__ import annotations

import tomllib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from math import isfinite
from pathlib import Path
from typing import Literal

from loopwright.serving.controller import Controller
from loopwright.serving.errors import LoopError
from loopwright.serving.fields import nearest, parse, refused
from loopwright.serving.guard import Allowed, Complete, Fresh, Frozen, Guard, InRange, Rate
from loopwright.serving.manifest import Manifest, Signal
from loopwright.serving.modes import Fallback
from loopwright.serving.opcua.settings import Nodes, Server
from loopwright.serving.page.process import Page
from loopwright.serving.station.toml_lines import fresh_lines, key_of, node_id, operate_lines, text_of
from loopwright.serving.words import first_line, plain

MAX_AGE = 1.5  # periods: one answer may be late, two may not
TRANSFER = 20.0  # periods
MAX_SETTINGS_DEPTH = 20  # of lists and tables in each other


@dataclass(frozen=True, slots=True)
class Guards:
    """When a sample is refused. ``max_age_s`` None: after one and a half periods. ``frozen`` 0: never.

    ``margin`` is the share of a PV's range by which it may exceed it, ``frozen`` the samples for which a PV may stand
    still to the bit, ``rate`` the largest change of a PV from one sample to the next, in its unit.
    """

    max_age_s: float | None = None
    margin: float = 0.05
    frozen: int = 0
    rate: Mapping[str, float] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if self.max_age_s is not None and not (isfinite(self.max_age_s) and self.max_age_s > 0):
            raise LoopError(f"max_age_s is {self.max_age_s}; it must be above zero")
        if not 0 <= self.margin < 10:
            raise LoopError(f"margin is {self.margin}; it must be a share of the range, 0 or more")
        if self.frozen < 0 or self.frozen == 1:
            raise LoopError(f"frozen is {self.frozen}; it must be 0 (never) or a number of samples of at least 2")
        if not all(isfinite(r) and r > 0 for r in self.rate.values()):
            raise LoopError(f"rate is {dict(self.rate)}; each must be above zero")

    def of(self, manifest: Manifest, max_age_s: float) -> tuple[Guard, ...]:
        """The guards for a controller."""
        guards: list[Guard] = [
            Complete(manifest), Allowed(manifest.mv), InRange(manifest.pv, self.margin), Fresh(max_age_s),
        ]  # fmt: skip
        if self.frozen:
            guards.append(Frozen(manifest.pv, self.frozen))
        if self.rate:
            known = [s.name for s in manifest.pv]
            for name in self.rate:
                if name not in known:
                    raise LoopError(f"guards.rate has {name!r}, which is no PV{nearest(name, known)}")
            guards.append(Rate(manifest.pv, tuple(self.rate.get(name, float("inf")) for name in known)))
        return tuple(guards)


@dataclass(frozen=True, slots=True)
class Bridge:
    """The PVs whose reading alone is bad, for a law that reads ``fresh``; any other holds at once.

    The law predicts such a PV for ``bridge_s`` [s] (None: ten periods) and then leaves it out; without one of the
    ``critical`` PVs, or without any controlled one, the loop holds then.
    """

    bridge_s: float | None = None
    critical: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        if self.bridge_s is not None and not (isfinite(self.bridge_s) and self.bridge_s >= 0):
            raise LoopError(f"bridge_s is {self.bridge_s}; it must be a finite number of seconds, 0 or more")


@dataclass(frozen=True, slots=True)
class Local:
    """The MVs that the plant has itself, for a law with ``use`` of them; nodes.local says where the plant tells.

    It has one, too, that reads back elsewhere than commanded for ``after_s`` [s] (0: never, None: 20 periods).
    """

    after_s: float | None = None

    def __post_init__(self) -> None:
        if self.after_s is not None and not (isfinite(self.after_s) and self.after_s >= 0):
            raise LoopError(f"after_s is {self.after_s}; it must be a finite number of seconds, 0 (never) or more")


@dataclass(frozen=True, slots=True)
class Hold:
    """Action after a fault.

    ``recover_after`` good samples lead back to AUTO; 0: only the operator does. A fault of more than ``max_s`` is for
    ``then``: ``stay`` with the last MV, go to the ``safe`` MVs at a ``rate`` [mv units/s], or ``hand back`` to the
    plant's own controller (nodes.hand_back).
    """

    recover_after: int = 5
    max_s: float = 60.0
    then: Literal["stay", "safe", "hand back"] = "stay"
    safe: Mapping[str, float] = field(default_factory=dict)
    rate: Mapping[str, float] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if self.recover_after < 0:
            raise LoopError(f"recover_after is {self.recover_after}; it must be 0 or more good samples")
        if (self.then == "safe") != bool(self.safe):
            raise LoopError('safe MVs go with then = "safe", and it with them')

    def fallback(self, mv: tuple[Signal, ...]) -> Fallback | None:
        """The task of the loop; LoopError where an MV has no safe value or rate, or one outside its range."""
        if self.then == "stay":
            return None
        if self.then == "hand back":
            return Fallback(self.max_s, hand_back=True)
        names = [s.name for s in mv]
        for word, given in (("safe", self.safe), ("rate", self.rate)):
            for name in given:
                if name not in names:
                    raise LoopError(f"hold.{word} has {name!r}, which is no MV{nearest(name, names)}")
            if missing := [n for n in names if n not in given]:
                raise LoopError(f"hold.{word} lacks {', '.join(missing)}")
        found = Fallback(self.max_s, tuple(self.safe[n] for n in names), tuple(self.rate[n] for n in names))
        found.check(mv)
        return found


@dataclass(frozen=True, slots=True)
class JournalSettings:
    """Where every scan is written down, how much of it is kept, and whether each write waits for the disk."""

    file: Path = Path("loop.journal")
    max_mb: float = 2000.0
    fsync: Literal["power loss", "crash"] = "crash"

    def __post_init__(self) -> None:
        if not (isfinite(self.max_mb) and self.max_mb >= 1):
            raise LoopError(f"max_mb is {self.max_mb}; it must be at least 1")


@dataclass(frozen=True, slots=True)
class Settings:
    """A loop: controller, plant, guards, fallback, journal, page. Paths are relative to the file that names them.

    ``trusted`` names public keys: only a controller that one of them signed is loaded, at the start and by a swap
    (None: any is). ``accept_unproven`` lets a controller into AUTO whose file does not prove it in closed loop, see
    ``loopwright.serving.trust``. ``local`` says when the plant has an MV itself. ``operate`` has values of the law's
    ``operate`` by name that the loop begins with, in place of the law's own; with ``restore`` those that operators had
    set when the last loop ended come in their place, its set points, and its courses as far as they lie in the future,
    if its controller is the same. ``page`` is
    HOST:PORT or a table (see ``loopwright.serving.page.process``); empty: none.
    """

    controller: Path
    server: Server
    nodes: Nodes
    sha256: str = ""
    trusted: tuple[Path, ...] | None = None
    start: Literal["SHADOW", "MANUAL", "AUTO"] = "SHADOW"
    accept_unproven: bool = False
    speed: float = 1.0
    transfer_s: float | None = None
    guards: Guards = Guards()
    fresh: Bridge = Bridge()
    local: Local = Local()
    operate: Mapping[str, float | bool] = field(default_factory=dict)
    restore: bool = False
    hold: Hold = Hold()
    journal: JournalSettings = JournalSettings()
    page: str | Page = ""

    def __post_init__(self) -> None:
        if not (isfinite(self.speed) and self.speed > 0):
            raise LoopError(f"speed is {self.speed}; it must be above zero (1 is real time)")
        if self.transfer_s is not None and not (isfinite(self.transfer_s) and self.transfer_s >= 0):
            raise LoopError(f"transfer_s is {self.transfer_s}; it must be a finite number of seconds, 0 or more")
        if self.trusted == ():
            raise LoopError("trusted names no public key, so no controller could be loaded; name one, or leave it out")
        if self.hold.then == "hand back" and self.nodes.hand_back is None:
            raise LoopError('hold.then is "hand back", but nodes.hand_back does not say by which node')
        if isinstance(self.page, str) and self.page:
            Page(self.page)  # refuses an address that is none

    @classmethod
    def read(cls, path: Path) -> Settings:
        """The settings in a file. LoopError for a file that is none, and for every mistake in it."""
        try:
            tree = tomllib.loads(path.read_text(encoding="utf-8-sig"))
        except OSError as error:
            raise LoopError(f"{path} cannot be read: {error.strerror}") from None
        except ValueError as error:  # of TOML, of UTF-8, or an integer of thousands of digits
            raise LoopError(f"{path} is not TOML: {first_line(error)}") from None
        except RecursionError:
            raise LoopError(f"{path} is not TOML that can be read: lists or tables are nested too deep") from None
        if why := refused(tree, MAX_SETTINGS_DEPTH):
            raise LoopError(f"{path} has {why}")
        found = parse(cls, tree, str(path), LoopError)
        at = path.parent
        s = found.server
        server = replace(
            s,
            certificate=_under(at, s.certificate),
            private_key=_under(at, s.private_key),
            server_certificate=_under(at, s.server_certificate),
            password_file=_under(at, s.password_file),
            user_certificate=_under(at, s.user_certificate),
            user_key=_under(at, s.user_key),
        )
        journal = replace(found.journal, file=at / found.journal.file)
        page = found.page
        if isinstance(page, Page):
            page = replace(
                page,
                token_file=_under(at, page.token_file),
                certificate=_under(at, page.certificate),
                private_key=_under(at, page.private_key),
            )
        trusted = None if found.trusted is None else tuple(at / key for key in found.trusted)
        return replace(
            found, controller=at / found.controller, trusted=trusted, server=server, journal=journal, page=page
        )

    def served(self) -> Page | None:
        """The page that is asked for."""
        if isinstance(self.page, Page):
            return self.page
        return Page(self.page) if self.page else None

    def over_s(self, period_s: float) -> float:
        """Time [s] over which an MV goes to where a law wants it that takes over."""
        return TRANSFER * period_s if self.transfer_s is None else self.transfer_s

    def max_age_s(self, period_s: float) -> float:
        """Age from which on a sample is refused."""
        return MAX_AGE * period_s if self.guards.max_age_s is None else self.guards.max_age_s


def _under(folder: Path, path: Path | None) -> Path | None:
    return None if path is None else folder / path


# ------------------------------------------------------------ loop.toml for a controller, with a comment on every line
def template(controller: Controller, path: Path, endpoint: str, journal: str = "loop.journal") -> str:
    """The text of a loop.toml beside which ``path`` lies, for a plant at ``endpoint``."""
    m = controller.manifest
    period, over = m.period_s, TRANSFER * m.period_s
    lines = [
        f"# The loop of {plain(m.law)} for {plain(m.case)}, a scan every {period:g} s.",
        "# `loopwright loop check` reads every node and writes none.",
        f"controller = {text_of(path.as_posix())}",
        f'sha256 = "{controller.sha256}"  # this very file and no other',
        '# trusted = ["maker.pub"]  # only controllers that one of these public keys signed; see docs/trust.md',
        'start = "SHADOW"  # the law is computed and shown, nothing is written; or MANUAL, AUTO',
        *["# restore = true  # begins with what operators had set when it last ended"] * bool(m.operate),
        "# accept_unproven = true  # lets a controller into AUTO although its file does not prove it",
        "# speed = 10  # times the clock, for a plant that is simulated as fast: `loopwright plant serve --speed 10`",
        'page = "127.0.0.1:8080"  # the operator\'s page; leave it out for none',
        f"transfer_s = {over:g}  # [s] in which an MV crosses its range at most once after a change to AUTO",
        "",
        "[server]",
        f"endpoint = {text_of(endpoint)}",
        'security = "Basic256Sha256"  # signed and encrypted',
        'certificate = "loop-certificate.der"  # let the server trust it',
        'private_key = "loop-key.pem"  # keep it to yourself',
        '# server_certificate = "server.der"  # pins the server: no other one is spoken to',
        '# user = "loopwright"',
        '# password_env = "LOOP_PASSWORD"  # the environment variable that holds it; or password_file',
        '# user_certificate = "user.der"  # in place of user and password; its key in user_key = "user-key.pem"',
        '# uncertain = "use"  # values of uncertain quality; without it they are a fault',
        "# rewrite_s = 10  # [s] after which an MV that has not changed is written again; without it at every scan",
        '# source_time = "ignore"  # for a server that stamps a value only when it changes',
        "",
        '# The node of every signal: a node id, or { node = "...", scale = 1.0, offset = 0.0 } with',
        "# value = scale raw + offset. Name the namespace (nsu=): its number (ns=2) may be another one after the",
        "# server's next start, and the loop then holds. `loopwright loop check` says which name a number has.",
        "[nodes.pv]",
        *(_node("PV", s) for s in m.pv),
        "",
        "[nodes.mv]  # read_back: what the actuator really has",
        *(
            f"{key_of(s.name)} = {{ node = {text_of(node_id('MV', s.name))}, "
            f"read_back = {text_of(node_id('RB', s.name))} }}  # {_words(s)}"
            for s in m.mv
        ),
    ]
    if m.dv:
        unused = "" if "dv" in m.inputs else "  # this law does not use them: they are only written down"
        lines += ["", f"[nodes.dv]{unused}", *(_node("DV", s) for s in m.dv)]
    lines += [
        "",
        "# [nodes.sp]  # set points that the plant's own operator sets",
        *(f"# {_node('SP', s)}" for s in m.sp),
        *operate_lines(m),
        "",
        "[nodes]  # what the two sides tell each other; leave out what the plant has not",
        f'heartbeat = "{node_id("Control", "Heartbeat")}"  # counts the scans, for the plant to watch',
        f'watchdog = "{node_id("Control", "Watchdog")}"  # a number that the plant changes while it lives',
        "watchdog_scans = 3  # without a change: a fault",
        '# lease = "nsu=...;s=..."  # a text: which loop writes; unnamed: LoopwrightLease beside the MVs; or "none"',
        f'# hand_back = {{ node = "{node_id("Control", "Owner")}", value = 0 }}',
        "",
        "[guards]  # when a sample is refused: the loop holds",
        f"max_age_s = {MAX_AGE * period:g}",
        "margin = 0.05  # share of a PV's range by which it may exceed it",
        "frozen = 0  # samples for which a PV may stand still to the bit; 0: for ever",
        f"# rate = {_table(m.pv, lambda s: (s.high - s.low) / 10)}  # largest change a scan",
        *fresh_lines(m),
        "",
        "[hold]  # what follows a fault",
        "recover_after = 5  # good samples until AUTO; 0: only the operator",
        'max_s = 60  # [s]; after that: "stay", "safe" or "hand back"',
        'then = "stay"',
        f"# safe = {_table(m.mv, lambda s: s.middle)}",
        f"# rate = {_table(m.mv, lambda s: (s.high - s.low) / 60)}  # [unit/s] on the way there",
        "",
        "[journal]",
        f"file = {text_of(journal)}",
        "max_mb = 2000  # the oldest scans go beyond that",
        'fsync = "crash"  # what it survives without loss; "power loss" waits for the disk each time',
        "",
    ]
    return "\n".join(_ordered(lines))


def _ordered(lines: Sequence[str]) -> list[str]:
    """TOML wants a table before its own sub-tables: [nodes] goes first."""
    start = lines.index("[nodes]  # what the two sides tell each other; leave out what the plant has not")
    end = lines.index("", start)
    first = lines.index('# The node of every signal: a node id, or { node = "...", scale = 1.0, offset = 0.0 } with')
    return [*lines[:first], *lines[start : end + 1], *lines[first:start], *lines[end + 1 :]]


def _node(group: str, s: Signal) -> str:
    return f"{key_of(s.name)} = {text_of(node_id(group, s.name))}  # {_words(s)}"


def _table(signals: Sequence[Signal], value: Callable[[Signal], float]) -> str:
    return "{ " + ", ".join(f"{key_of(s.name)} = {value(s):g}" for s in signals) + " }"


def _words(s: Signal) -> str:
    unit = "" if s.unit == "-" else f" {plain(s.unit)}"
    return f"{s.low:g} .. {s.high:g}{unit}"
