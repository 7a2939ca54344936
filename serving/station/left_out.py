"""Process variables that operators have taken out, and that leave their range: nothing holds them there."""

from __future__ import annotations

from collections.abc import Callable, Mapping

from loopwright.serving.guard import Sample
from loopwright.serving.loop import Command, ControlLoop
from loopwright.serving.modes import Mode

WELL_INSIDE = 0.01  # of a PV's range, within its ends: noise at an end would raise and end the alarm scan by scan


class LeftOut:
    """Raises an alarm while a PV that somebody has taken out is outside the range that operators gave it.

    A PV that is left out for its reading has an alarm of its own, and no number to judge. In another mode than AUTO
    somebody else has the plant.
    """

    def __init__(self, say: Callable[[str, str, bool], None]) -> None:
        self._say = say  # words, name of the PV, raised or over
        self._gone: Mapping[str, str] = {}

    def look(self, loop: ControlLoop, sample: Sample | None, command: Command) -> None:
        """Say what has changed at a scan of ``loop``; one without a sample, or a step of the law, says nothing."""
        if sample is None or command.law_mv is None:
            return
        m, gone = loop.controller.manifest, dict[str, str]()
        of = dict(zip([e.name for e in m.operate], loop.operate.tolist(), strict=True)) if m.operate else {}
        for s, value in zip(m.pv, sample.pv.tolist(), strict=False):
            if (
                command.mode is not Mode.AUTO
                or of.get(f"{s.name}.use", 1.0)
                or s.name in command.shed
                or s.name in command.bridged
            ):
                continue
            low, high = of.get(f"{s.name}.low", s.low), of.get(f"{s.name}.high", s.high)
            # One that has gone is back only well inside.
            inside = WELL_INSIDE * (s.high - s.low) if s.name in self._gone else 0.0
            if value > high - inside:
                gone[s.name] = f"above its high limit of {high:g} {s.unit}".rstrip()
            elif value < low + inside:
                gone[s.name] = f"below its low limit of {low:g} {s.unit}".rstrip()
        for name, why in gone.items():
            if name not in self._gone:
                self._say(f"PV {name} is taken out, and {why}: nothing holds it", name, True)
        for name in self._gone:
            if name not in gone:
                self._say(f"over: PV {name} is within its range, or controlled again", name, False)
        self._gone = gone
