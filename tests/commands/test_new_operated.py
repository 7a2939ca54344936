"""``loopwright new`` with constraints, analysers, ranges, rests and costs: what params.yaml says of ``operate``."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from loopwright.pipeline.cases.own_entries import entries_of
from loopwright.pipeline.commands.new import signals_of
from loopwright.pipeline.commands.own_plant.number_options import limited
from loopwright.pipeline.commands.own_plant.operator_ranges import OperatorDefaults, usual_range
from loopwright.pipeline.config.params import parse
from loopwright.pipeline.config.plants import PlantParams
from loopwright.pipeline.errors import RecordError
from loopwright.pipeline.historian.cleaning.tags import TableError, Tag, named, parse_tag, read_tags
from loopwright.pipeline.historian.export_params import exported, signal_tags
from loopwright.pipeline.historian.guessing import controlled_first
from loopwright.pipeline.laws.predictive.operating import entries_of as operate_entries
from loopwright.pipeline.plants.simulator import Signals
from loopwright.pipeline.records.record import Record
from loopwright.serving.manifest import Signal

PVS = (Signal("TI", "degC", 0.0, 200.0), Signal("AI", "%", 0.0, 10.0), Signal("PI", "bar", 0.0, 6.0))
MVS = (Signal("u1", "%", 0.0, 100.0), Signal("u2", "%", 0.0, 100.0))


def record(*, seldom: bool = False) -> Record:
    rng = np.random.default_rng(0)
    n = 2_000
    pv = np.column_stack([rng.normal(120, 5, n), rng.normal(4, 0.5, n), rng.normal(2.5, 0.2, n)])
    mv = rng.uniform(20, 80, (n, 2))
    found = Record.of(Signals(10.0, PVS[:2], PVS, (), MVS), pv, mv)
    if not seldom:
        return found
    fresh = np.ones(pv.shape, dtype=np.bool_)
    fresh[:, 1] = np.arange(n) % 20 == 3
    return replace(found, fresh=fresh)


def tags(**of: dict[str, object]) -> tuple[Tag, ...]:
    plain = [Tag(s.name, role, s.unit, name=s.name) for role, group in (("pv", PVS), ("mv", MVS)) for s in group]
    return tuple(replace(t, **of.get(t.name, {})) for t in plain)  # type: ignore[arg-type]


def test_without_such_roles_the_entries_are_as_before() -> None:
    operated = OperatorDefaults.of(record(), tags())
    assert operated.defaults is None
    assert operated.controlled is None
    plant = signals_of(record(), tags())
    assert "controlled" not in plant
    assert all(set(s) == {"name", "unit", "low", "high"} for s in plant["pv"])
    entries = entries_of("x", plant | {"data": "d"}, None, (), operated.defaults)
    assert entries == entries_of("x", plant | {"data": "d"})
    assert set(entries["controllers"]) == {"x-predictive", "x-pid"}
    assert "operate" not in entries["controllers"]["x-predictive"]
    assert entries["models"]["x-identified"]["parts"]["identified"] == {"kind": "identified", "minutes": 4.0}


def test_a_constraint_has_the_range_of_its_record_and_all_pvs_are_outputs() -> None:
    listed = tags(PI={"constraint": True}, u1={"rest": 40.0, "cost": 1.5}, TI={"rank": 1.0, "range_high": 150.0})
    operated = OperatorDefaults.of(record(), listed)
    assert operated.controlled == 2
    found = operated.defaults
    assert found is not None
    inside = (record().pv[:, 2] >= found["PI.low"]) & (record().pv[:, 2] <= found["PI.high"])
    assert 0.985 < inside.mean() < 1.0
    others = {name: value for name, value in found.items() if not name.startswith("PI.")}
    assert others == {"TI.high": 150.0, "TI.rank": 1.0, "u1.rest": 40.0, "u1.rest_use": 1.0, "u1.cost": 1.5}
    assert len(operated.lines) == 1
    entries = entries_of("x", signals_of(record(), listed) | {"controlled": 2, "data": "d"}, None, (), found)
    assert entries["controllers"]["x-predictive"]["operate"] == found
    parts = entries["models"]["x-identified"]["parts"].values()
    assert all(part["outputs"] == "measured" and part["minutes"] == 6.0 for part in parts)
    # The law takes every one of these defaults.
    signals = Signals(10.0, PVS[:2], PVS, (), MVS)
    defaults = {entry.name: entry.default for entry in operate_entries(signals, 3, (), (), found)}
    assert {name: defaults[name] for name in found} == found
    assert defaults["PI.track"] == 0.0


def test_a_given_range_is_taken_as_it_is() -> None:
    operated = OperatorDefaults.of(record(), tags(PI={"constraint": True, "range_low": 2.0, "range_high": 3.0}))
    assert operated.defaults == {"PI.low": 2.0, "PI.high": 3.0}
    assert operated.lines == []
    with pytest.raises(RecordError, match=r"PI: low is -1"):
        OperatorDefaults.of(record(), tags(PI={"constraint": True, "range_low": -1.0, "range_high": 3.0}))
    with pytest.raises(RecordError, match=r"u2: rest is 120"):
        OperatorDefaults.of(record(), tags(u2={"rest": 120.0}))


def test_an_analyser_with_a_set_point_has_its_spacing_and_no_pid() -> None:
    listed = tags(AI={"analyser": True})
    operated = OperatorDefaults.of(record(seldom=True), listed)
    assert operated.defaults == {}
    assert operated.controlled is None
    plant = signals_of(record(seldom=True), listed)
    assert [s.get("every", 1) for s in plant["pv"]] == [1, 20, 1]
    params = parse(PlantParams, plant | {"data": "d"}, "plants.x")
    assert params.pv[1].every == 20
    entries = entries_of("x", plant | {"data": "d"}, None, (), operated.defaults)
    assert set(entries["controllers"]) == {"x-predictive"}
    assert entries["controllers"]["x-predictive"]["operate"] == {}


def test_a_constraint_that_is_an_analyser_leaves_the_pid() -> None:
    record_of_both = record(seldom=True)
    swapped = replace(record_of_both, fresh=record_of_both.fresh[:, [0, 2, 1]])  # type: ignore[index]
    listed = tags(PI={"analyser": True, "constraint": True})
    plant = signals_of(swapped, listed) | {"controlled": 2, "data": "d"}
    assert "x-pid" in entries_of("x", plant, None, (), OperatorDefaults.of(swapped, listed).defaults)["controllers"]


def test_roles_and_numbers_of_the_table_and_of_options_are_one(tmp_path: Path) -> None:
    table = tmp_path / "t.csv"
    table.write_text(
        "tag,role,low,high,range_low,range_high,rank,rest,cost\nTI,pv,0,200,,,,,\nAI,analyser,,,,,1,,-2\n"
        "PI,constraint,0,6,2,3,,,\nQI,constraint-analyser,,,,,,,\nu1,mv,0,100,,,,40,1\n"
    )
    of_table = read_tags(table)
    options = [("pv", "TI=0..200"), ("analyser", "AI"), ("constraint", "PI=0..6"), ("constraint-analyser", "QI")]
    given = tuple(parse_tag(text, role) for role, text in (*options, ("mv", "u1=0..100")))
    numbers = {"range": ["PI=2..3"], "rank": ["AI=1"], "rest": ["u1=40"], "cost": ["AI=-2", "u1=1"]}
    assert limited(given, numbers) == of_table
    assert [t.role for t in of_table] == ["pv", "pv", "pv", "pv", "mv"]
    # What params.yaml keeps of them is their role; the numbers stand with the controller.
    kept = signal_tags([exported(t) for t in named(of_table)])
    roles = {"TI": "pv", "AI": "analyser", "PI": "constraint", "QI": "constraint-analyser", "u1": "mv"}
    assert {t.tag: t.stated_role for t in kept} == roles


def test_constraints_come_last_whatever_loops_say() -> None:
    listed = (Tag("PI.PV", "pv", constraint=True), Tag("TI.PV", "pv"), Tag("LI.PV", "pv"), Tag("LI.SP", "sp"))
    assert [t.tag for t in controlled_first(listed) if t.role == "pv"] == ["LI.PV", "TI.PV", "PI.PV"]
    assert [t.tag for t in controlled_first(listed[:3])] == ["TI.PV", "LI.PV", "PI.PV"]


@pytest.mark.parametrize(
    ("line", "why"),
    [
        ("TI,pv,0,9,5,4,,,", "range_low must be below"),
        ("TI,pv,0,9,-1,4,,,", "range_low is -1"),
        ("TI,pv,,,,,7,,", "rank is 7"),
        ("TI,pv,,,,,,3,", "rest belongs to a mv"),
        ("TI,dv,,,1,2,,,", "range_low belongs to a pv"),
        ("TI,mv,0,9,,,,20,", "rest is 20"),
    ],
)
def test_a_number_that_cannot_be_is_said_with_its_line(tmp_path: Path, line: str, why: str) -> None:
    table = tmp_path / "t.csv"
    table.write_text(f"tag,role,low,high,range_low,range_high,rank,rest,cost\n{line}\n")
    with pytest.raises(TableError, match=why) as found:
        read_tags(table)
    assert "line 2 (TI)" in str(found.value)


def test_a_range_of_the_record_keeps_its_digits_beside_a_large_mean() -> None:
    rng = np.random.default_rng(1)
    low, high = usual_range(rng.normal(1_000.0, 0.01, 5_000), Signal("x", "", 900.0, 1_100.0))
    assert 0.04 < high - low < 0.06
    assert usual_range(np.full(10, 3.0), Signal("x", "", 0.0, 5.0)) == (0.0, 5.0)
