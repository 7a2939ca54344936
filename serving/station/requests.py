"""Requests to a running loop, checked before it comes near the loop."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple, TypeAlias

from loopwright.serving.clock import MonotonicClock
from loopwright.serving.controller import Controller
from loopwright.serving.errors import LoopError
from loopwright.serving.fields import is_number, nearest, shown
from loopwright.serving.in_charge.adapted import require_fits
from loopwright.serving.journal.entries import Kind
from loopwright.serving.loop import ControlLoop, Mode, within
from loopwright.serving.manifest import Signal
from loopwright.serving.opcua.sampling import Values
from loopwright.serving.preview.course import described
from loopwright.serving.preview.course_file import asked_course
from loopwright.serving.station.change_words import by_hand_words, moved_words, operate_words
from loopwright.serving.station.recorder import named
from loopwright.serving.trust import require_accepted, signer

MODE = "mode"


class Asked(NamedTuple):
    """Requests of the plant's own operator: set points by name, the mode, values of ``operate`` by name."""

    sp: dict[str, float]
    mode: str
    operate: dict[str, float]


class NodeRequests:
    """Requests of the plant's own operator by nodes: a value that has changed is one.

    The set points and the values of ``operate`` that stand there when the loop begins are requests, too; the mode is
    none. The values of a server that has started anew are its defaults: nobody asked for them, and they are no request
    until they change. A ``use`` of ``operate`` is a contact, which shows how the plant stands: it is a request also
    where it stands otherwise after the start than before it.
    """

    def __init__(self) -> None:
        self._stands: dict[str, float | str] = {}  # since the loop began, or the server did
        self.starts = 0  # of the server, as far as its values were looked at
        self._unheard: Mapping[str, str] = {}

    def of(self, values: Values) -> Asked:
        """The requests of these values; empty where there are none."""
        if values.starts != self.starts:
            self.starts = values.starts
            self._stands = {
                name: value for name, value in self._stands.items() if name.startswith("operate ") and is_contact(name)
            }
        points = {n: v for n, v in values.asked_sp.items() if self._changed(f"SP {n}", v, first=self.starts == 0)}
        first = self.starts == 0
        operate = {
            n: v
            for n, v in values.asked_operate.items()
            if self._changed(f"operate {n}", v, first=first or is_contact(n))
        }
        mode = values.asked_mode
        return Asked(points, mode if mode and self._changed(MODE, mode, first=False) else "", operate)

    def refused(self, values: Values) -> list[str]:
        """Why a set point or the mode is no request, in a line for each; each is told once while it lasts."""
        before, self._unheard = self._unheard, values.unheard
        return [why for name, why in values.unheard.items() if name not in before]

    def _changed(self, name: str, value: float | str, *, first: bool) -> bool:
        """Whether a value is a request; ``first``: also one that is seen for the first time."""
        before = self._stands.get(name)
        self._stands[name] = value
        return first if before is None else before != value


def is_contact(name: str) -> bool:
    """Whether a node of ``operate`` shows a state of the plant, as that a valve is in local, and not what is wanted."""
    return name.endswith(".use")


# -------------------------------------------------------------------------------------------- by commands and the page
Opened: TypeAlias = Callable[[str, str | None], Controller]  # file, its pinned SHA-256 or None

LONGEST_NAME, LONGEST_REASON = 60, 300  # letters
TRIAL, LONGEST_TRIAL = 60, 1_000_000  # scans


@dataclass(frozen=True, slots=True)
class Change:
    """A change that somebody wants: ``act`` does it, ``what`` says it, ``done`` is told how it went (empty: well)."""

    act: Callable[[ControlLoop], None]
    what: str
    who: str
    reason: str = ""
    done: Callable[[str], None] = lambda _: None
    kind: Kind = "change"
    mode: Mode | None = None  # to which it changes the mode


@dataclass(frozen=True, slots=True)
class Request:
    """The request, by whom and why."""

    do: str
    value: Any
    who: str
    reason: str
    accept_unproven: bool = False  # the word that AUTO needs with a controller that is not proven

    @classmethod
    def read(cls, tree: Any) -> Request:
        """LoopError for anything else than an object with ``do``, ``who`` and, if need be, ``value`` and ``reason``."""
        if not isinstance(tree, Mapping) or not isinstance(tree.get("do"), str):
            raise LoopError('a request is an object with "do"')
        known = ("do", "value", "who", "reason", "accept_unproven")
        unknown = sorted(set(tree) - set(known))
        if unknown:
            raise LoopError(f"a request has no {unknown[0]!r}{nearest(unknown[0], known)}")
        who, reason = tree.get("who", ""), tree.get("reason", "")
        for word, text, most in (("who", who, LONGEST_NAME), ("reason", reason, LONGEST_REASON)):
            if not isinstance(text, str) or len(text) > most or not (text.isprintable()):
                raise LoopError(f"{word} must be a line of at most {most} characters")
        if not who.strip():
            raise LoopError("who is empty: a change is written down with a name")
        accept = tree.get("accept_unproven", False)
        if not isinstance(accept, bool):
            raise LoopError("accept_unproven is true or false")
        return cls(tree["do"], tree.get("value"), who.strip(), reason.strip(), accept)


def change(request: Request, loop: ControlLoop, opened: Opened) -> Change:
    """The change of the loop that is asked for; LoopError or ArtifactError where it would be refused.

    A file of another controller is read here, by ``opened``, so that no scan waits for it.
    """
    does = {
        "mode": _mode,
        "sp": _sp,
        "mv": _mv,
        "by_hand": _by_hand,
        "operate": _operate,
        "course": _course,
        "swap": _swap,
        "keep": _keep,
        "back": _back,
    }
    made = does.get(request.do)
    if made is None:
        known = (*does, "acknowledge", "state", "about", "inputs")
        raise LoopError(f"the loop cannot {request.do!r}{nearest(request.do, known)}")
    return made(request, loop, opened)


def _mode(request: Request, loop: ControlLoop, _: Opened) -> Change:
    if request.value not in [m.value for m in Mode]:
        raise LoopError(f"mode is {request.value!r}{nearest(request.value, [m.value for m in Mode])}")
    mode = Mode(request.value)
    if mode is not Mode.AUTO:
        what = f"mode {loop.mode} -> {mode}"
        return Change(lambda loop: loop.set_mode(mode), what, request.who, request.reason, mode=mode)
    unproven = require_proven(loop, request.accept_unproven)
    said = f"accepted though {unproven}" if unproven else ""
    reason = "; ".join(filter(None, (request.reason, said)))

    def act(loop: ControlLoop) -> None:
        require_proven(loop, request.accept_unproven)  # another controller may have taken over since
        loop.set_mode(mode)

    return Change(act, f"mode {loop.mode} -> {mode}", request.who, reason, mode=mode)


def require_proven(loop: ControlLoop, accepted: bool) -> str:
    """Doubts on the controllers that write in AUTO, the one on trial included; empty without any.

    LoopError where something is not, and nobody accepts it.
    """
    those = [loop.controller, *([] if loop.successor is None else [loop.successor.controller])]
    return "; ".join(filter(None, (require_accepted(c.manifest, accepted).words for c in those)))


def _sp(request: Request, loop: ControlLoop, _: Opened) -> Change:
    signals = loop.controller.manifest.sp
    wanted = _numbers(request.value, signals, loop.sp.tolist(), "set point")
    within(wanted, signals, "set point")
    what = moved_words(loop.sp.tolist(), wanted, signals, "set point")
    followed = [name for name in request.value if name in loop.courses.ends]

    def act(loop: ControlLoop) -> None:
        # Of what stands there then: somebody else may have changed another one since.
        loop.set_sp(_numbers(request.value, signals, loop.sp.tolist(), "set point"))
        loop.courses.end(request.value)  # also where the value stays: the one who sets it wants it to

    return Change(act, f"{what}{ended_words(followed)}", request.who, request.reason)


def ended_words(names: Sequence[str]) -> str:
    """Words that say of which signals a course ends; none of none."""
    return f"; the course of {', '.join(names)} ends" if names else ""


def _course(request: Request, loop: ControlLoop, _: Opened) -> Change:
    # Dates of a file are those of the clock, which a plant for trials may outrun.
    speed = loop.clock.speed if isinstance(loop.clock, MonotonicClock) else 1.0
    value = {"end": list(loop.courses.ends)} if request.value is None else request.value
    points, straight, names, filed = asked_course(value, time.time(), speed)
    if set(value) == {"end"}:
        without = [name for name in names if name not in loop.courses.ends]
        if without or not names:
            raise LoopError(f"{', '.join(without) or 'no signal'} has a course now")
        what = f"the course of {', '.join(names)} ends"
        return Change(lambda loop: _ended(loop, names), what, request.who, request.reason)
    try:
        loop.require_course(points, straight)
    except LoopError as error:
        error.entry = "csv" if filed else error.entry
        raise
    m = loop.manifest
    return Change(
        lambda loop: loop.set_course(points, straight, request.who),
        f"course of {described(points, (*m.sp, *m.dv))}",
        request.who,
        request.reason,
    )


def _ended(loop: ControlLoop, names: Sequence[str]) -> None:
    loop.courses.end(names)


def _mv(request: Request, loop: ControlLoop, _: Opened) -> Change:
    signals = loop.controller.manifest.mv
    wanted = _numbers(request.value, signals, loop.mv_wanted.tolist(), "MV")
    within(wanted, signals, "MV")
    loop.require_in_hand(request.value)
    what = moved_words(loop.mv_wanted.tolist(), wanted, signals, "MV")

    def act(loop: ControlLoop) -> None:
        loop.require_in_hand(request.value)
        loop.set_mv(_numbers(request.value, signals, loop.mv_wanted.tolist(), "MV"))

    return Change(act, what, request.who, request.reason)


def _by_hand(request: Request, loop: ControlLoop, _: Opened) -> Change:
    """MVs that are taken out of the law's use, if they are not, and sent to values; the law keeps the others."""
    signals, take = loop.controller.manifest.mv, request.value
    wanted = _numbers(request.value, signals, loop.mv_wanted.tolist(), "MV")
    _within(wanted, signals, request.value)
    loop.require_in_hand(take, take)
    places = [i for i, s in enumerate(signals) if s.name in take]
    of = dict(zip([e.name for e in loop.controller.manifest.operate], loop.operate.tolist(), strict=True))
    old, new = ([values[i] for i in places] for values in (loop.mv_wanted.tolist(), wanted))
    taken = [name for name in take if of.get(f"{name}.use")]
    what = by_hand_words(old, new, [signals[i] for i in places], taken)

    def act(loop: ControlLoop) -> None:
        loop.set_mv(_numbers(request.value, signals, loop.mv_wanted.tolist(), "MV"), take)

    return Change(act, what, request.who, request.reason)


def _within(wanted: list[float], signals: tuple[Signal, ...], named: Mapping[str, float]) -> None:
    """LoopError with the ``entry`` of the first value outside its range."""
    for s, value in zip(signals, wanted, strict=True):
        try:
            if s.name in named:
                within([value], (s,), "MV")
        except LoopError as error:
            error.entry = s.name
            raise


def _operate(request: Request, loop: ControlLoop, _: Opened) -> Change:
    entries, present = loop.controller.manifest.operate, loop.operate
    wanted = loop.operate_with(request.value)
    if not request.value:
        raise LoopError(f"a value of operate is given by name: {', '.join(e.name for e in entries)}")
    names = [e.name for e in entries]
    before, after = (dict(zip(names, of.tolist(), strict=True)) for of in (present, wanted))
    asked = {name: after[name] for name in request.value}
    what = operate_words(entries, before, asked, loop.controller.manifest.period_s)
    return Change(lambda loop: loop.set_operate(request.value), what, request.who, request.reason)


def _swap(request: Request, loop: ControlLoop, opened: Opened) -> Change:
    value = request.value
    if not isinstance(value, Mapping) or not isinstance(value.get("file"), str) or not value["file"]:
        raise LoopError('a swap needs {"file": a controller\'s .onnx, "trial": a number of scans}')
    trial = value.get("trial", TRIAL)
    sha256 = value.get("sha256")
    if not (sha256 is None or isinstance(sha256, str)):
        raise LoopError("sha256 is no text")
    return _tried(request, loop, opened(value["file"], sha256), trial)


def _back(request: Request, loop: ControlLoop, _: Opened) -> Change:
    if loop.replaced is None:
        raise LoopError("no controller was replaced since this loop began")
    trial = request.value.get("trial", TRIAL) if isinstance(request.value, Mapping) else TRIAL
    return _tried(request, loop, loop.replaced, trial)


def _tried(request: Request, loop: ControlLoop, controller: Controller, trial: Any) -> Change:
    if not isinstance(trial, int) or isinstance(trial, bool) or not 1 <= trial <= LONGEST_TRIAL:
        raise LoopError(f"trial is {trial!r}; it must be a whole number of scans, 1 .. {LONGEST_TRIAL}")
    require_fits(controller.manifest, loop.manifest)
    if controller.sha256 == loop.controller.sha256:
        raise LoopError(f"{named(controller)} is in charge already")
    unproven = require_accepted(controller.manifest, request.accept_unproven or loop.mode in {Mode.SHADOW, Mode.MANUAL})
    signed = signer(controller)
    by = "" if signed is None else f", signed by {signed.words},"
    what = f"{named(controller)}{by} beside {named(loop.controller)} for {trial} scans"
    said = f"accepted though {unproven.words}" if unproven.why and request.accept_unproven else ""
    reason = "; ".join(filter(None, (request.reason, said)))

    def act(loop: ControlLoop) -> None:
        if loop.mode in {Mode.AUTO, Mode.HOLD}:  # since when it was asked
            require_accepted(controller.manifest, request.accept_unproven)
        loop.swap(controller, trial)

    return Change(act, what, request.who, reason, kind="swap")


def _keep(request: Request, loop: ControlLoop, _: Opened) -> Change:
    if loop.successor is None:
        raise LoopError("no controller is on trial")
    what = f"{named(loop.successor.controller)} is tried no more"
    return Change(lambda loop: loop.keep(), what, request.who, request.reason, kind="swap")


def _numbers(value: Any, signals: tuple[Signal, ...], present: list[float], what: str) -> list[float]:
    """The present values with those that are named changed."""
    names = [s.name for s in signals]
    if not isinstance(value, Mapping) or not value:
        raise LoopError(f"a {what} is given by name: {', '.join(names)}")
    wanted = list(present)
    for name, number in value.items():
        if name not in names:
            raise LoopError(f"there is no {what} {name!r}{nearest(name, names)}")
        if not is_number(number):
            raise LoopError(f"the {what} {name} is {shown(number)}; it must be a number")
        wanted[names.index(name)] = float(number)
    return wanted
