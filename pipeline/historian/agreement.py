"""Statements that ``exports.<plant>`` and ``plants.<plant>`` of params.yaml share: names, units, ranges, period."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from loopwright.pipeline.config.exports import ExportParams
from loopwright.pipeline.config.plants import MvParams, PlantParams, SignalParams
from loopwright.pipeline.errors import ParamsError
from loopwright.pipeline.historian.tags import COMMANDS, SIGNAL_ROLES, Tag
from loopwright.pipeline.records.record import Record
from loopwright.serving.manifest import Signal

Stated = SignalParams | MvParams


def stated(plant: PlantParams) -> dict[tuple[str, str], Stated]:
    """(role, name) -> signal of the plant."""
    groups: dict[str, Sequence[Stated]] = {"pv": plant.pv, "mv": plant.mv, "dv": plant.dv}
    return {(role, s.name): s for role, group in groups.items() for s in group}


def limits_of(plant: PlantParams, tags: Sequence[Tag]) -> tuple[Tag, ...]:
    """The tags, MVs with what the controller may command of them."""
    mvs = {s.name: s for s in plant.mv}

    def limited(tag: Tag) -> Tag:
        return replace(tag, **{key: getattr(mvs[tag.name], key) for key in COMMANDS})

    return tuple(limited(t) if t.role == "mv" and t.name in mvs else t for t in tags)


def check_agreement(params: ExportParams, plant: PlantParams, tags: Sequence[Tag]) -> None:
    """ParamsError where a file is missing, or the named tags disagree with the plant's signals; a unit "" is open."""
    name, own = params.case, stated(plant)
    missing = [file for file in params.files if not file.is_file()]
    if missing:
        raise ParamsError(f"exports.{name}.files: {missing[0]} is not there; put it back, or correct the path")
    signals = {(t.role, t.name): t for t in tags if t.role in SIGNAL_ROLES}
    wrong = [f"exports.{name} has a {role} {s!r}, plants.{name} has none" for role, s in signals.keys() - own.keys()]
    wrong += [f"plants.{name} has a {role} {s!r}, exports.{name} has none" for role, s in own.keys() - signals.keys()]
    for key in signals.keys() & own.keys():
        tag, signal = signals[key], own[key]
        if tag.unit and tag.unit != signal.unit:
            wrong.append(f"{tag.name} is in {tag.unit!r} in the export, in {signal.unit!r} in plants.{name}")
        for end in ("low", "high"):
            value = getattr(tag, end)
            if value is not None and value != getattr(signal, end):
                wrong.append(
                    f"{tag.name}: {end} is {value:g} in exports.{name}, {getattr(signal, end):g} in plants.{name}"
                )
    if wrong:
        raise ParamsError(f"{'; '.join(sorted(wrong))}; {_remedy(name)}")


def check_period(params: ExportParams, plant: PlantParams, period_s: float) -> None:
    """ParamsError where the record has another sampling period than the plant."""
    if period_s != plant.period_s:
        exact = repr(plant.period_s).removesuffix(".0")  # as it compares
        raise ParamsError(
            f"the record of exports.{params.case} has a period of {period_s:.9g} s, plants.{params.case} has "
            f"{plant.period_s:.9g} s; write `period_s: {exact}` in exports.{params.case}, or "
            f"{_remedy(params.case)}"
        )


def within_stated(plant: PlantParams, tags: Sequence[Tag], record: Record) -> tuple[Tag, ...]:
    """The tags, those whose record goes beyond the plant's range with this range as a given one."""
    own = stated(plant)
    signals = (*record.pv_signals, *record.mv_signals, *record.dv_signals)
    columns = (*record.pv.T, *record.mv.T, *record.dv.T)
    ends = {s.name: (float(v.min()), float(v.max())) for s, v in zip(signals, columns, strict=True)}

    def ranged(tag: Tag) -> Tag:
        if tag.role not in SIGNAL_ROLES:
            return tag
        signal, (least, most) = own[tag.role, tag.name], ends[tag.name]
        low = signal.low if tag.low is None and least < signal.low else tag.low
        high = signal.high if tag.high is None and most > signal.high else tag.high
        return replace(tag, low=low, high=high)

    return tuple(map(ranged, tags))


def as_stated(plant: PlantParams, record: Record) -> Record:
    """The record with the signals of the plant."""
    own = stated(plant)

    def of(role: str, signals: Sequence[Signal]) -> tuple[Signal, ...]:
        found = [own[role, s.name] for s in signals]
        return tuple(Signal(s.name, s.unit, s.low, s.high) for s in found)

    return replace(
        record,
        pv_signals=of("pv", record.pv_signals),
        mv_signals=of("mv", record.mv_signals),
        dv_signals=of("dv", record.dv_signals),
    )


def _remedy(name: str) -> str:
    return f"make the two agree, or write both anew: `loopwright new {name} ... --replace`"
