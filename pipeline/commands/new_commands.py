"""What a controller may command, beside what a record or a simulator shows of its MVs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from pipeline.config.plants import mistakes_of_mv
from pipeline.errors import RecordError
from pipeline.historian.findings import InputReport
from pipeline.historian.tags import Tag
from pipeline.metrics import Array
from pipeline.plants.simulator import Simulator
from serving.manifest import Signal

LEAST_SHARED = 0.05  # of the commanded or the visited range, the smaller one: what both must share


def mvs_of(plant: Simulator) -> tuple[Tag, ...]:
    """The MVs of a simulator that states its signals itself."""
    return tuple(Tag(s.name, "mv", s.unit, s.low, s.high, s.name) for s in plant.mv_signals)


def check_commands(signals: Sequence[Signal], tags: Sequence[Tag]) -> None:
    """RecordError where an MV's range of commands leaves its own range, which a simulator may have stated itself."""
    for s in signals:
        tag = next((t for t in tags if t.name == s.name), None)
        if tag is not None and (wrong := mistakes_of_mv(replace(tag, low=s.low, high=s.high))):
            low, high = _ends(s.name, s.low, s.high, tags)
            raise RecordError(
                f"{s.name} may be commanded from {low:g} to {high:g} {s.unit}, outside its range: {'; '.join(wrong)}"
            )


def commanded(inputs: Sequence[InputReport], tags: Sequence[Tag]) -> list[InputReport]:
    """The inputs, the MVs with the ranges that may be commanded: a step test stays within them."""
    ends = [_ends(i.name, i.low, i.high, tags) for i in inputs]
    return [replace(i, low=low, high=high) for i, (low, high) in zip(inputs, ends, strict=True)]


def confirmed(signals: Sequence[Signal], tags: Sequence[Tag]) -> list[str]:
    """What the controller may command, a line for each MV of which a person said it."""
    lines = []
    for s in signals:
        limits = next((t.commands for t in tags if t.name == s.name), {})
        if limits:
            low, high = _ends(s.name, s.low, s.high, tags)
            fastest = limits.get("max_move_per_min")
            pace = "" if fastest is None else f", at most {fastest:g} {s.unit} in a minute"
            lines.append(f"{s.name}: the controller may command {low:g} to {high:g} {s.unit}{pace}")
    return lines


def unvisited(signal: Signal, values: Array, tags: Sequence[Tag]) -> str:
    """Why an MV cannot be commanded as wished: its record (n,) hardly went there; empty where it can."""
    low, high = _ends(signal.name, signal.low, signal.high, tags)
    least, most = float(values.min()), float(values.max())
    if min(most, high) - max(least, low) >= LEAST_SHARED * min(most - least, high - low):
        return ""
    return (
        f"{signal.name} may be commanded from {low:g} to {high:g} {signal.unit}, but moved only from {least:g} to "
        f"{most:g} in the record, so nothing is known of the plant there; widen command_low or command_high, or add a "
        "record of that range"
    )


def check_start(plant: Simulator, tags: Sequence[Tag]) -> None:
    """RecordError where tests on a simulator would begin at an MV that may not be commanded."""
    for signal, value in zip(plant.mv_signals, plant.start[1], strict=True):
        low, high = _ends(signal.name, signal.low, signal.high, tags)
        if not low <= value <= high:
            raise RecordError(
                f"the simulator starts with {signal.name} = {value:g} {signal.unit}, and {low:g} to {high:g} may be "
                "commanded; widen that range, or let the simulator start within"
            )


def _ends(name: str, low: float, high: float, tags: Sequence[Tag]) -> tuple[float, float]:
    commands = next((t.commands for t in tags if t.name == name), {})
    return commands.get("command_low", low), commands.get("command_high", high)
