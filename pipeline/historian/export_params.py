"""``exports.<plant>`` of params.yaml: screened as by `loopwright new`, and in agreement with ``plants.<plant>``."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from loopwright.pipeline.config.exports import ExportedTag, ExportParams
from loopwright.pipeline.config.plants import MvParams, PlantParams, SignalParams
from loopwright.pipeline.errors import ParamsError
from loopwright.pipeline.historian.cleaning.tags import COMMANDS, SIGNAL_ROLES, Tag, named, of_role, safe_name
from loopwright.pipeline.historian.files.file_reader import read_export, units_of
from loopwright.pipeline.historian.guessing import controlled_first, loop_of
from loopwright.pipeline.historian.screening import Screened, screen_export
from loopwright.pipeline.records.record import Record
from loopwright.serving.manifest import Signal

# -------------------------------------------------------------- what both sections state: names, units, ranges, period
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


# --------------------------------------------------------------------------------------------- the record of a section
def exported(tag: Tag) -> ExportedTag:
    """The entry of a tag that a person gave; what the controller may command stands with the plant."""
    name = "" if tag.name == safe_name(tag.tag) else tag.name
    # What column loop says as the name does needs no word.
    said = (tag.unit_certain, tag.between, tag.ends, "" if tag.loop == loop_of(tag.tag) else tag.loop)
    return ExportedTag(tag.tag, tag.stated_role, tag.unit, tag.low, tag.high, name, *said)  # type: ignore[arg-type]


def signal_tags(tags: Sequence[ExportedTag]) -> tuple[Tag, ...]:
    """The tags with the names and in the order of the plant's signals; units as given."""
    given = [
        of_role(
            Tag(
                *(t.tag, t.role, t.unit, t.low, t.high, t.name),
                unit_certain=t.unit_certain,
                between=t.between,
                ends=t.ends,
                loop=t.loop,
            )
        )
        for t in tags
    ]
    return controlled_first(named(given))


def with_units(tags: Sequence[Tag], params: ExportParams) -> tuple[Tag, ...]:
    """The tags, those without a unit with the unit that the files state."""
    units = units_of(params.files)
    return tuple(t if t.unit or t.role == "mode" else replace(t, unit=units.get(t.tag, "")) for t in tags)


def read_and_screen(params: ExportParams, tags: Sequence[Tag]) -> Screened:
    """The files read and screened; ``tags`` have names and units. Errors of ``read_export`` and ``screen_export``."""
    values, modes = ([t.tag for t in tags if (t.role == "mode") is mode] for mode in (False, True))
    export = read_export(params.files, values, modes, params.time, params.time_format, params.time_zone)
    return screen_export(
        params.case, export, tags, params.period_s, params.hold_s, params.without_mode, leave_out=params.leave_out
    )
