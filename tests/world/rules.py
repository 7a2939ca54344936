"""What must hold after each period of a loop, by what its plant, its operators and its connection did.

A rule knows nothing of how the loop keeps its state: only what was asked, what a sample showed, what went out and
whether it arrived.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from math import isnan

from loopwright.serving import Mode
from world.acts import HIGH, LOW, MOVE, RECOVER_AFTER, TARGET, Seen, World

SOUND = ("good", "refused", "raises")  # samples that tell where the MV stands
GOOD = ("good", "blind")  # samples on which the law may act


@dataclass(frozen=True, slots=True)
class Known:
    """What the world knows of a loop between two periods."""

    told: float | None = None  # the last MV that arrived, or that was found; None: nobody knows one
    doubt: bool = False  # others may have moved the MV since: a write was lost, or they had it
    lost: bool = False  # a write was lost
    bad: bool = False  # since the doubt began, a read-back was none
    reads: bool = False  # whether the plant has ever read back an MV, soundly or not
    hand: float | None = None  # where an operator sent the MV, in MANUAL ever since
    good: int = 0  # good samples in a row since a fault
    fault: bool = False  # whether HOLD is by a fault
    refused: bool = False  # whether the last sample was

    @classmethod
    def at_start(cls, world: World) -> Known:
        """Before the first period."""
        mv = float(world.loop.mv[0])
        return cls(told=None if isnan(mv) else mv)

    def after(self, s: Seen) -> tuple[Known, list[str]]:
        """The same after a period, and which rules it broke."""
        asked = self._asked(s)
        shown = asked._shown(s)
        broken = list(_broken(self, asked, shown, s))
        after = shown._gone_out(s)
        if s.act.lost and s.written is not None:
            # It stays where it was before, unless the sample has found it; in MANUAL it goes where it was to go.
            by_hand = s.command.mode is Mode.MANUAL
            goal = shown.told if shown.hand is None else shown.hand
            found = asked.doubt or (asked.told is None and asked.hand is not None)
            told = shown.told if found else asked.told
            after = replace(after, told=told, hand=goal if by_hand else None)
        return after, broken

    def _asked(self, s: Seen) -> Known:
        """Before the scan: operators have asked."""
        request = s.act.request
        if not s.accepted:
            return self
        if isinstance(request, Mode):
            taken = self.lost or (request is not Mode.SHADOW and (self.doubt or s.before is Mode.SHADOW))
            hand = self.hand if request is s.before else None
            return replace(self, doubt=taken, hand=hand, fault=False, good=0)
        return replace(self, hand=request)

    def _shown(self, s: Seen) -> Known:
        """At the scan: the sample has told where the MV stands, or that nothing will."""
        sample = s.act.sample
        reads = self.reads or sample in SOUND or sample == "outside"
        known = replace(self, reads=reads, refused=sample not in GOOD)
        if sample in SOUND:
            # A refused sample tells where an MV stands that others had, or that an operator sends, and no more.
            found = self.doubt or (self.told is None and (sample != "refused" or self.hand is not None))
            found = found or (sample == "raises" and _mode_at(s) in (Mode.AUTO, Mode.SHADOW))
            told, hand = (s.plant if found else self.told), (None if self.lost else self.hand)
            bad = self.bad and sample == "refused" and not self.doubt
            return replace(known, told=told, hand=hand, doubt=False, bad=bad, lost=False)
        if sample == "blind":
            told = None if self.bad else self.told
            return replace(known, told=told, doubt=False, bad=False, lost=False, refused=told is None)
        if not reads:
            return replace(known, doubt=False, lost=False)
        bad = sample == "outside"
        nowhere = self.doubt or self.told is None
        return replace(known, bad=self.bad or (self.doubt and bad), hand=None if bad and nowhere else self.hand)

    def _gone_out(self, s: Seen) -> Known:
        """After the scan: what was written has arrived, or not."""
        good = 0 if self.refused else self.good + 1
        known = replace(self, fault=bool(s.fault), good=good if s.fault else 0)
        if s.command.mode is Mode.SHADOW and s.act.sample == "good":
            return replace(known, told=s.plant)
        if s.written is None:
            return known
        if s.act.lost:
            return replace(known, doubt=True, lost=True, good=0)
        arrived = replace(known, told=s.written)
        return replace(arrived, hand=None) if s.written == known.hand else arrived


def _mode_at(s: Seen) -> Mode:
    """The mode in which a scan begins."""
    return s.act.request if isinstance(s.act.request, Mode) and s.accepted else s.before


def _broken(before: Known, asked: Known, now: Known, s: Seen) -> Iterator[str]:
    yield from _modes(before, asked, s)
    written, mode, sample = s.written, s.command.mode, s.act.sample
    if mode is Mode.SHADOW and s.command.writes:
        yield "nothing is written in SHADOW"
    if now.doubt and written is not None:
        yield "nothing is written while nobody knows where the MV stands"
    if written is None:
        if mode is not Mode.SHADOW and not now.doubt and now.told is not None:
            yield "a loop that knows where the MV stands goes on writing it"
        return
    if isnan(written) or not LOW <= written <= HIGH:
        yield "a written MV lies within its range"
    stands = s.plant if sample in SOUND else now.told
    if now.told is None and sample != "good":
        if mode is not Mode.MANUAL or written != now.hand:
            yield "nothing but an operator's word says where an MV stands that is never read back"
        return
    near = [place for place in (stands, now.told) if place is not None]
    if min(abs(written - place) for place in near) > MOVE:
        yield "an MV moves by no more than it may, from where it stands or was told to"
    if mode is Mode.AUTO and stands is not None:
        if sample not in GOOD:
            yield "no MV of the law goes out by a sample that was refused"
        elif written != stands + max(-MOVE, min(MOVE, TARGET - stands)):
            yield "in AUTO the law's MV goes out"
    if mode is Mode.HOLD and written != now.told:
        yield "HOLD holds"
    if mode is Mode.MANUAL and now.told is not None:
        way = 0.0 if now.hand is None else now.hand - now.told
        if written != now.told + max(-MOVE, min(MOVE, way)):
            yield "in MANUAL the MV goes where the operator sent it, and stays there"


def _modes(before: Known, asked: Known, s: Seen) -> Iterator[str]:
    request, mode, sample = s.act.request, s.command.mode, s.act.sample
    was = _mode_at(s)
    blind_shadow = s.before is Mode.SHADOW and before.refused
    if isinstance(request, Mode) and s.accepted == (blind_shadow and request is not Mode.SHADOW):
        yield "a mode is refused to a shadow without a good sample, and to nobody else"
    if isinstance(request, float) and s.accepted and s.before is not Mode.MANUAL:
        yield "an MV by hand is taken in MANUAL alone"
    if mode is was:
        if mode is Mode.AUTO and s.command.fault:
            yield "a fault in AUTO changes the mode to HOLD"
        if mode is Mode.HOLD and asked.fault and sample in GOOD and not s.command.fault:
            yield "a fault ends after so many good samples"
        return
    if was is Mode.AUTO and mode is Mode.HOLD:
        if not s.command.fault:
            yield "HOLD has a fault that says why"
    elif was is Mode.HOLD and mode is Mode.AUTO:
        if not (asked.fault and sample in GOOD and asked.good + 1 == RECOVER_AFTER):
            yield "a fault ends after so many good samples"
    else:
        yield "a mode changes by request, by a fault or by its end"
