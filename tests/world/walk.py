"""Histories of a loop that break a rule: among all up to a depth, and among random ones from a seed.

Of all sequences those that lead to the same loop, and to the same knowledge of it, are walked once. A random one that
breaks a rule is shortened: acts are left out, and made simpler, while the rule is still broken.
"""

from __future__ import annotations

import pickle
import random
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field

from loopwright.serving import Mode
from world.acts import ACTS, REQUESTS, SAMPLES, Act, World
from world.rules import Known

Nothing = Callable[[int, int, int], None]


@dataclass(slots=True)
class Walk:
    """What was walked: loops that differ, periods, and the first history that broke each rule."""

    states: int = 0
    periods: int = 0
    broken: dict[str, tuple[str | Act, ...]] = field(default_factory=dict)


def starts() -> dict[str, World]:
    """Loops at their start: in each mode that a loop begins in, with and without an MV that is known."""
    modes = (Mode.AUTO, Mode.MANUAL, Mode.SHADOW)
    return {
        f"{mode}, {'MV known' if mv else 'MV not known'}": World.begun(mode, mv) for mode in modes for mv in (None, 2.0)
    }


def walked(
    depth: int,
    begin: Mapping[str, World],
    acts: Iterable[Act] = ACTS,
    *,
    tell: Nothing = lambda *_: None,
    first: bool = False,
) -> Walk:
    """Walk all sequences of ``acts`` of ``depth`` periods; with ``first`` until a rule is broken.

    A sequence ends where it has broken a rule.
    """
    made, acts = Walk(), tuple(acts)
    front: list[tuple[bytes, Known, tuple[str | Act, ...]]] = []
    for name, world in begin.items():
        front.append((world.frozen(), Known.at_start(world), (name,)))
    seen = {(data, pickle.dumps(known)) for data, known, _ in front}
    for level in range(depth):
        beyond = []
        for data, known, path in front:
            for act in acts:
                world = World.thawed(data)
                after, broken = known.after(world.do(act))
                made.periods += 1
                for rule in broken:
                    made.broken.setdefault(rule, (*path, act))
                if broken:
                    if first:
                        return made
                    continue
                key = world.frozen(), pickle.dumps(after)
                if key not in seen:
                    seen.add(key)
                    beyond.append((key[0], after, (*path, act)))
        front = beyond
        made.states = len(seen)
        tell(level + 1, made.states, made.periods)
    return made


def drawn(rng: random.Random) -> Act:
    """An act as they come: mostly nobody asks or moves anything, and writes arrive."""
    request = rng.choice(REQUESTS) if rng.random() < 0.35 else None
    return Act(request, rng.random() < 0.15, rng.choice(SAMPLES), rng.random() < 0.15)


def broken_by(start: World, acts: Iterable[Act]) -> tuple[str, int]:
    """The first rule that a history breaks, and its period; empty, and -1, where it breaks none."""
    world = World.thawed(start.frozen())
    known = Known.at_start(world)
    for k, act in enumerate(acts):
        known, broken = known.after(world.do(act))
        if broken:
            return broken[0], k
    return "", -1


def wandered(seed: int, histories: int, periods: int = 12) -> tuple[str, tuple[str | Act, ...], int]:
    """Random histories until one breaks a rule: the rule, the history as short as it gets, periods that ran."""
    rng, begin, ran = random.Random(seed), starts(), 0
    for _ in range(histories):
        name = rng.choice(sorted(begin))
        acts = [drawn(rng) for _ in range(periods)]
        rule, last = broken_by(begin[name], acts)
        ran += periods if last < 0 else last + 1
        if rule:
            return rule, (name, *shortened(begin[name], acts[: last + 1], rule)), ran
    return "", (), ran


def shortened(start: World, acts: list[Act], rule: str) -> list[Act]:
    """The history without acts, and without parts of acts, that the broken rule does not need."""
    k = 0
    while k < len(acts):
        fewer = acts[:k] + acts[k + 1 :]
        if broken_by(start, fewer)[0] == rule:
            acts = fewer
            continue
        for part in Act._fields:
            simpler = [*acts[:k], acts[k]._replace(**{part: Act._field_defaults[part]}), *acts[k + 1 :]]
            acts = simpler if broken_by(start, simpler)[0] == rule else acts
        k += 1
    return acts
