"""The variables of an FMU that become the signals of a plant, as options, as a corrected table, or as the FMU says."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from loopwright.pipeline.errors import RecordError
from loopwright.pipeline.historian.cleaning.tags import SIGNAL_ROLES, Guess, Tag, named, write_tags
from loopwright.pipeline.plants.fmu.description import Description, Variable, described
from loopwright.pipeline.plants.fmu.program import variable_of
from loopwright.pipeline.plants.fmu.table import FmuRow, FmuTable

PROPOSED = {"input": "mv", "output": "pv"}
MISSING = "give its range"


def table_from(path: Path, tags: Sequence[Tag], where: str, period_s: float | None) -> FmuTable | None:
    """The table of the signals; None where no tag is given and the FMU leaves something to a person.

    Unit and range are the tag's, else the FMU's. PlantError as ``described`` and ``variable_of``; RecordError for a
    role that an FMU has no use for, a range that nobody states, and a period that the FMU cannot have.
    """
    of = described(path)
    if not tags:
        tags = [g.tag for g in proposals(of)]
        if not _clear(tags):
            return None
    other = [t for t in tags if t.role not in SIGNAL_ROLES]
    if other:
        raise RecordError(f"{where}: {other[0].tag} has the role {other[0].role}; of an FMU only pv, mv and dv count")
    found = [_with_range(t, variable_of(of, t.tag, t.role)) for t in named(tags)]
    without = [t for t in found if t.low is None or t.high is None]
    if without:
        raise RecordError(
            f"{where}: {', '.join(t.tag for t in without)}: neither the FMU nor you state a range; give one, as in "
            f'--{without[0].role} "{without[0].tag}=LOW..HIGH" or in the table of --tags'
        )
    return FmuTable(_step(of, period_s), tuple(FmuRow(t.tag, t.role, t.signal(0.0, 0.0)) for t in found))


def proposals(of: Description) -> list[Guess]:
    """Inputs as MVs, outputs as PVs, and the other variables without a role, as far as they could be a PV."""
    found = [v for v in of.variables.values() if v.causality in PROPOSED]
    return [Guess(_tag(v), 0.0, 1.0, notes=(_remark(v),)) for v in sorted(found, key=lambda v: v.causality)]


def write_table(path: Path, fmu: Path) -> int:
    """Write the proposals for a person to correct, and their number; RecordError where the file is there."""
    rows = proposals(described(fmu))
    write_tags(path, rows)
    return len(rows)


def _clear(tags: Sequence[Tag]) -> bool:
    """Whether nothing is left to a person: one input, which can only be an MV, and all ranges."""
    return [t.role for t in tags].count("mv") == 1 and all(t.low is not None and t.high is not None for t in tags)


def _tag(v: Variable) -> Tag:
    return Tag(v.name, PROPOSED[v.causality], v.unit, v.low, v.high)


def _remark(v: Variable) -> str:
    start = "" if v.start is None else f"starts at {v.start:g}"
    role = "an input: mv or dv" if v.causality == "input" else ""
    missing = MISSING if v.low is None or v.high is None else ""
    return "; ".join(filter(None, (role, start, missing, v.words)))


def _with_range(tag: Tag, v: Variable) -> Tag:
    low, high = (v.low if tag.low is None else tag.low), (v.high if tag.high is None else tag.high)
    return replace(tag, unit=tag.unit or v.unit, low=low, high=high)


def _step(of: Description, period_s: float | None) -> float:
    """The communication step [s]: the period itself where the FMU allows it, else what the FMU proposes."""
    step = period_s if of.step_s is None or (of.any_step and period_s is not None) else of.step_s
    if step is None:
        raise RecordError(f"{of.path} proposes no step size; give the sampling period, as in --period 10")
    return step
