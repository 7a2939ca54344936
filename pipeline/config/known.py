"""Knowledge of an engineer on a pair of PV and input: sign, none, gain, dead time; ``plants.<name>.known``."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any, Literal

NONE = "none"
FORMS = "+, -, none, gain LOW..HIGH, dead FROM..TO, with commas between them, as in '+, gain 0.5..2, dead 30..60'"
PART = re.compile(r"^(?P<what>gain|dead)\s+(?P<low>[^.\s]*(\.\d+)?[^.\s]*)\s*\.\.\s*(?P<high>\S+)$", re.IGNORECASE)
SIGNS: dict[str, Literal["+", "-", "none"]] = {"+": "+", "-": "-", "−": "-", NONE: "none"}

CONTRADICTION_SDS = 3.0
"""Standard deviations by which a record must be certain before it contradicts an engineer."""

NO_ANSWER = 0.1
"""Change of a PV by a move of an input, both over their standard deviations in the record: a smaller answer is none."""

DEAD_TIME_ROUNDING = 1e-6
"""Share of a period: a dead time of whole periods in seconds is that many periods."""


@dataclass(frozen=True, slots=True)
class Known:
    """How ``pv`` answers to ``input``, an MV or a measured disturbance, as far as somebody knows.

    ``sign`` of its steady gain, of an integrating PV that of its slope; ``none``: the input does not move it. ``gain``:
    the steady gain lies from .. to [PV/input]. ``dead_s``: the dead time lies from .. to [s]. Fields that are left out
    are not known. Raises ValueError where the statements contradict each other.
    """

    pv: str
    input: str
    sign: Literal["", "+", "-", "none"] = ""
    gain: tuple[float, float] | None = None
    dead_s: tuple[float, float] | None = None

    def __post_init__(self) -> None:
        if wrong := self._mistake():
            raise ValueError(f"{self.pair}: {wrong}")

    def _mistake(self) -> str:
        for what, ends in (("gain", self.gain), ("dead", self.dead_s)):
            if ends is not None and not (math.isfinite(ends[0]) and math.isfinite(ends[1])):
                return f"{what} {_span(ends)} is no range of finite numbers"
            if ends is not None and ends[0] > ends[1]:
                return f"{what} {_span(ends)}: the first number must not be above the second"
        if self.dead_s is not None and self.dead_s[0] < 0:
            return f"dead {_span(self.dead_s)}: a dead time cannot be negative"
        if not self.says:
            return f"it says nothing; write {FORMS}"
        if self.sign == NONE and (self.gain or self.dead_s):
            return f"{self.says} contradicts itself: what has no effect has neither gain nor dead time"
        low, high = self.gain or (-math.inf, math.inf)
        if (self.sign == "+" and high <= 0) or (self.sign == "-" and low >= 0):
            return f"{self.says} contradicts itself: no gain in that range has the sign {self.sign}"
        return ""

    @property
    def pair(self) -> str:
        """PV and input, as ``--known`` names them."""
        return f"{self.pv}/{self.input}"

    @property
    def says(self) -> str:
        """The statement, as ``--known`` takes it."""
        return ", ".join(filter(None, (self.says_gain, self.says_dead)))

    @property
    def says_gain(self) -> str:
        """The part of the statement on sign and gain; empty where it has none."""
        return ", ".join(filter(None, (self.sign, f"gain {_span(self.gain)}" if self.gain else "")))

    @property
    def says_dead(self) -> str:
        """The part of the statement on the dead time; empty where it has none."""
        return f"dead {_span(self.dead_s)}" if self.dead_s else ""

    @property
    def gains(self) -> tuple[float, float]:
        """The gains that it allows [PV/input]; infinite ends where nothing is said, 0 .. 0 for none."""
        if self.sign == NONE:
            return 0.0, 0.0
        low, high = self.gain or (-math.inf, math.inf)
        return (max(low, 0.0) if self.sign == "+" else low), (min(high, 0.0) if self.sign == "-" else high)

    @property
    def way(self) -> int:
        """The sign that it states or implies, 1 or -1; 0 where it leaves that open."""
        low, high = self.gains
        return 0 if self.sign == NONE else int(low >= 0) - int(high <= 0)

    def excludes(self, gain: float, sd: float, least: float = 0.0) -> bool:
        """Whether a gain certain to ``sd`` [PV/input] lies outside of what is said, by ``CONTRADICTION_SDS`` of them.

        ``least``: a gain below it is none.
        """
        low, high = self.gains
        return not (low - least <= gain + CONTRADICTION_SDS * sd and gain - CONTRADICTION_SDS * sd <= high + least)

    def question(self, gain: float, sd: float) -> str:
        """The question where a record is certain of another gain."""
        return (
            f"{self.pair}: {self.says!r} is said, and the record is certain of {gain:.3g} ± {sd:.2g}: is a tag turned "
            "round, or the statement?"
        )

    def dead_question(self, least_s: float, most_s: float | None) -> str:
        """The question where a record is certain of another dead time: not below ``least_s``, not above ``most_s``."""
        return (
            f"{self.pair}: {self.says_dead!r} is said, and the record is certain of "
            f"{span_words(least_s, most_s)}: is the statement right, in seconds, and are the tags the right ones?"
        )

    def to_dict(self) -> dict[str, Any]:
        """For params.yaml: what is not known is left out."""
        return {k: list(v) if isinstance(v, tuple) else v for k, v in asdict(self).items() if v not in ("", None)}


def periods_of(known: Known, period_s: float) -> tuple[int, int]:
    """Least and most whole periods of a stated dead time; ValueError where none is stated."""
    if known.dead_s is None:
        raise ValueError(f"{known.pair}: no dead time is stated")
    first, last = (math.floor(s / period_s + DEAD_TIME_ROUNDING) for s in known.dead_s)
    return first, last


def stated(pv: str, given: str, text: str) -> Known:
    """The statement of a text such as ``+, gain 0.5..2, dead 30..60`` on a pair; ValueError for another form."""
    found: dict[str, Any] = {}
    for part in re.split(r"\s*,(?!\d)\s*", text.strip()):  # 0,5 is a decimal comma
        match = PART.match(part)
        if part.lower() in SIGNS:
            key, value = "sign", SIGNS[part.lower()]
        elif match is not None:
            ends = tuple(_number(match[end], part) for end in ("low", "high"))
            key, value = {"gain": "gain", "dead": "dead_s"}[match["what"].lower()], ends  # type: ignore[assignment]
        else:
            raise ValueError(f"{part!r} is no statement; write {FORMS}")
        if found.get(key, value) != value:
            raise ValueError(f"{text} contradicts itself: two statements on {key.removesuffix('_s')}")
        found[key] = value
    return Known(pv, given, **found)


def together(statements: Sequence[Known]) -> tuple[Known, ...]:
    """One statement a pair, of several that add to each other; ValueError where two contradict each other."""
    found: dict[str, Known] = {}
    for one in statements:
        old = found.get(one.pair)
        mine, theirs = one.to_dict(), {} if old is None else old.to_dict()
        if old is not None and any(mine[key] != theirs[key] for key in mine.keys() & theirs.keys()):
            raise ValueError(f"{one.pair}: {old.says!r} and {one.says!r} contradict each other; keep one")
        found[one.pair] = one if old is None else _both(old, one)
    return tuple(found.values())


def _both(first: Known, second: Known) -> Known:
    more = {key: getattr(second, key) for key in ("sign", "gain", "dead_s") if getattr(second, key)}
    return replace(first, **more)


def _number(text: str, where: str) -> float:
    try:
        return float(text.replace(",", ".").replace("\N{MINUS SIGN}", "-"))
    except ValueError:
        raise ValueError(f"{where!r}: {text!r} is no number; write {FORMS}") from None


def span_words(least_s: float, most_s: float | None) -> str:
    """Least and most dead time [s] in words; None: there is no most."""
    return f"{least_s:g} s or more" if most_s is None else f"{least_s:g} to {most_s:g} s"


def _span(ends: tuple[float, float]) -> str:
    return f"{ends[0]:g}..{ends[1]:g}"
