"""loop.toml for a controller, with a comment on every line that a person may want to change."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

from loopwright.serving.controller import Controller
from loopwright.serving.manifest import Signal
from loopwright.serving.station.settings import MAX_AGE, TRANSFER
from loopwright.serving.words import plain


def template(controller: Controller, path: Path, endpoint: str, journal: str = "loop.journal") -> str:
    """The text of a loop.toml beside which ``path`` lies, for a plant at ``endpoint``."""
    m = controller.manifest
    period, over = m.period_s, TRANSFER * m.period_s
    lines = [
        f"# The loop of {plain(m.law)} for {plain(m.case)}, a scan every {period:g} s.",
        "# `loopwright loop check` reads every node and writes none.",
        f"controller = {_text(path.as_posix())}",
        f'sha256 = "{controller.sha256}"  # this very file and no other',
        '# trusted = ["maker.pub"]  # only controllers that one of these public keys signed; see docs/trust.md',
        'start = "SHADOW"  # the law is computed and shown, nothing is written; or MANUAL, AUTO',
        "# accept_unproven = true  # lets a controller into AUTO although its file does not prove it",
        "# speed = 10  # times the clock, for a plant that is simulated as fast: `loopwright plant serve --speed 10`",
        'page = "127.0.0.1:8080"  # the operator\'s page; leave it out for none',
        f"transfer_s = {over:g}  # [s] in which an MV crosses its range at most once after a change to AUTO",
        "",
        "[server]",
        f"endpoint = {_text(endpoint)}",
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
            f"{_key(s.name)} = {{ node = {_text(_id('MV', s.name))}, read_back = {_text(_id('RB', s.name))} }}"
            f"  # {_words(s)}"
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
        "",
        "[nodes]  # what the two sides tell each other; leave out what the plant has not",
        f'heartbeat = "{_id("Control", "Heartbeat")}"  # counts the scans, for the plant to watch',
        f'watchdog = "{_id("Control", "Watchdog")}"  # a number that the plant changes while it lives',
        "watchdog_scans = 3  # without a change: a fault",
        '# lease = "nsu=...;s=..."  # a text: which loop writes; unnamed: LoopwrightLease beside the MVs; or "none"',
        f'# hand_back = {{ node = "{_id("Control", "Owner")}", value = 0 }}',
        "",
        "[guards]  # when a sample is refused: the loop holds",
        f"max_age_s = {MAX_AGE * period:g}",
        "margin = 0.05  # share of a PV's range by which it may exceed it",
        "frozen = 0  # samples for which a PV may stand still to the bit; 0: for ever",
        f"# rate = {_table(m.pv, lambda s: (s.high - s.low) / 10)}  # largest change a scan",
        "",
        "[hold]  # what follows a fault",
        "recover_after = 5  # good samples until AUTO; 0: only the operator",
        'max_s = 60  # [s]; after that: "stay", "safe" or "hand back"',
        'then = "stay"',
        f"# safe = {_table(m.mv, lambda s: s.middle)}",
        f"# rate = {_table(m.mv, lambda s: (s.high - s.low) / 60)}  # [unit/s] on the way there",
        "",
        "[journal]",
        f"file = {_text(journal)}",
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


def _id(group: str, name: str) -> str:
    return f"nsu=urn:loopwright:plant;s={group}.{name}"


def _key(name: str) -> str:
    bare = name.replace("_", "").replace("-", "")
    return name if bare.isascii() and bare.isalnum() else _text(name)


def _text(value: str) -> str:
    """A text of TOML: a quote, a backslash or a line break in it ends neither the text nor the line."""
    escaped = value.replace("\\", "\\\\").replace('"', '\\"')
    return '"' + "".join(c if c.isprintable() else f"\\U{ord(c):08x}" for c in escaped) + '"'


def _node(group: str, s: Signal) -> str:
    return f"{_key(s.name)} = {_text(_id(group, s.name))}  # {_words(s)}"


def _table(signals: Sequence[Signal], value: Callable[[Signal], float]) -> str:
    return "{ " + ", ".join(f"{_key(s.name)} = {value(s):g}" for s in signals) + " }"


def _words(s: Signal) -> str:
    unit = "" if s.unit == "-" else f" {plain(s.unit)}"
    return f"{s.low:g} .. {s.high:g}{unit}"
