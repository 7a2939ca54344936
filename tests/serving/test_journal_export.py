"""A journal as training data: in the plant's time, run after run."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from loopwright.pipeline.historian.cleaning.tags import read_tags
from loopwright.serving import Controller, ControlLoop, Mode, Sample, Signal
from loopwright.serving.journal import Journal, JournalReader, ScanEntry, columns
from loopwright.serving.station.journal_export import export, tag_table
from loopwright.serving.station.recorder import Recorder

pytest_plugins = ["small_laws"]


def test_times_are_the_plants_and_runs_follow_each_other(tmp_path: Path, controller: Controller) -> None:
    m, width = controller.manifest, len(columns(controller.manifest))
    journal = Journal(tmp_path / "loop.journal")
    for began, speed in ((1e9, 100.0), (1e9 + 10, 100.0), (1.1e9, 1.0)):
        journal.begin(m, controller.sha256, began, speed)
        for k in range(40):
            when = began + k * m.period_s / speed
            journal.scan(ScanEntry(when, "AUTO", tuple(map(float, range(width))), reason=""))
    journal.close()
    assert export(tmp_path / "loop.journal", tmp_path / "loop.csv") == 120
    tag_table(tmp_path / "loop.journal", tmp_path / "tags.csv")
    tags = pd.read_csv(tmp_path / "tags.csv").set_index("tag")
    assert set(tags.index) == set(pd.read_csv(tmp_path / "loop.csv").columns) - {"time"}
    assert tags.loc[f"{m.pv[0].name}.PV", ["role", "name", "unit", "low", "high"]].tolist() == [
        "pv", m.pv[0].name, m.pv[0].unit, m.pv[0].low, m.pv[0].high,
    ]  # fmt: skip
    times = pd.to_datetime(pd.read_csv(tmp_path / "loop.csv")["time"])
    assert times.is_monotonic_increasing
    steps = times.diff().dt.total_seconds().to_numpy()
    within = np.delete(steps, [0, 40, 80])
    assert np.allclose(within, m.period_s, atol=2e-3)
    assert (steps[[40, 80]] >= m.period_s - 2e-3).all()


def test_the_mv_of_a_row_is_the_one_that_acts_after_its_pv(tmp_path: Path, controller: Controller) -> None:
    """The scan reads back what acted before it; a scan without a next one in its period has its own command."""
    m = controller.manifest
    names = columns(m)
    mv, pv = (f"{group} {s.name}" for group, s in (("mv", m.mv[0]), ("pv", m.pv[0])))
    back = f"applied {m.mv[0].name}"
    journal = Journal(tmp_path / "loop.journal")
    for began, read_back in ((1e9, True), (1e9 + 100 * m.period_s, False)):
        journal.begin(m, controller.sha256, began, 1.0)
        for k in (0, 1, 2, 5, 6):  # two scans were lost
            own = {mv: 10.0 + k, back: 9.0 + k if read_back else np.nan, pv: float(k)}
            journal.scan(ScanEntry(began + k * m.period_s, "AUTO", tuple(own.get(n, 0.0) for n in names), reason=""))
    journal.close()
    export(tmp_path / "loop.journal", tmp_path / "loop.csv")
    table = pd.read_csv(tmp_path / "loop.csv")
    assert table[f"{m.pv[0].name}.PV"].tolist() == [0, 1, 2, 5, 6] * 2
    # What the next scan read back, 9 + (k + 1), is what this one asked for; before the gap and at the end, the command.
    assert table[f"{m.mv[0].name}.OP"].tolist() == [10, 11, 12, 15, 16] * 2


def test_an_actuator_that_does_not_follow_is_believed(tmp_path: Path, controller: Controller) -> None:
    m = controller.manifest
    mv, back = (f"{group} {m.mv[0].name}" for group in ("mv", "applied"))
    journal = Journal(tmp_path / "loop.journal")
    journal.begin(m, controller.sha256, 1e9, 1.0)
    for k in range(3):
        own = {mv: 50.0, back: float(k)}
        numbers = tuple(own.get(name, 0.0) for name in columns(m))
        journal.scan(ScanEntry(1e9 + k * m.period_s, "AUTO", numbers, reason=""))
    journal.close()
    export(tmp_path / "loop.journal", tmp_path / "loop.csv")
    assert pd.read_csv(tmp_path / "loop.csv")[f"{m.mv[0].name}.OP"].tolist() == [1, 2, 50]


@pytest.mark.parametrize(("mode", "asks"), [(Mode.AUTO, True), (Mode.MANUAL, True), (Mode.SHADOW, False)])
def test_a_scan_without_a_good_sample_has_the_mv_that_is_written_on(
    tmp_path: Path, controller: Controller, mode: Mode, asks: bool
) -> None:
    """With a bad sensor no law is stepped; the loop goes on writing the MV it holds. A shadow asks for nothing."""
    journal = Journal(tmp_path / "loop.journal")
    recorder = Recorder(journal, lambda _: None)
    recorder.begin(controller)
    loop = ControlLoop(controller, sp=[1.0], mv=[40.0], mode=mode)
    commands = []
    for level in (0.8, np.nan, np.nan):
        sample = Sample(pv=np.array([level, 300.0]), dv=np.array([1.5]))
        commands.append(loop.scan(sample))
        recorder.scan(loop, sample, commands[-1])
    commands.append(loop.miss("the plant gives no values"))
    recorder.scan(loop, None, commands[-1])
    journal.close()
    assert [c.law_mv is None for c in commands] == [False, True, True, True]
    assert [c.writes for c in commands] == [asks] * 4
    reader = JournalReader(tmp_path / "loop.journal")
    at = columns(controller.manifest).index("mv valve")
    asked = [scan.numbers[at] for _, _, scan in reader.scans()]
    reader.close()
    assert asked == pytest.approx([float(c.mv[0]) if asks else np.nan for c in commands], nan_ok=True)
    export(tmp_path / "loop.journal", tmp_path / "loop.csv")
    exported = pd.read_csv(tmp_path / "loop.csv")["valve.OP"]  # nothing reads the valve back
    assert exported.notna().all() if asks else exported.isna().all()


def test_the_table_of_tags_says_that_units_are_certain(tmp_path: Path, controller: Controller) -> None:
    m = controller.manifest
    journal = Journal(tmp_path / "loop.journal")
    journal.begin(m, controller.sha256, 1e9, 1.0)
    journal.close()
    tag_table(tmp_path / "loop.journal", tmp_path / "tags.csv")
    tags = {tag.tag: tag for tag in read_tags(tmp_path / "tags.csv")}
    assert all(tag.unit_certain for tag in tags.values() if tag.role != "mode")


BAD, UNCERTAIN, GOOD = 0x8000_0000, 0x4000_0000, 0x0000_0001
FAULT = "PV level: BadSensorFailure"


@pytest.mark.parametrize(
    ("quality", "reason", "empty"),
    [
        ((), "", []),
        ((GOOD,) * 4, "", []),
        ((BAD, 0, 0, 0), FAULT, ["level.PV"]),
        ((BAD, 0, 0, 0), "", ["level.PV"]),
        ((0, BAD, 0, 0), FAULT, ["T.PV"]),
        ((0, 0, BAD, 0), FAULT, ["valve.OP"]),
        ((0, 0, 0, BAD), "", ["inflow.DV"]),
        ((0, UNCERTAIN, 0, 0), "", []),  # the loop used it
        ((0, UNCERTAIN, 0, 0), "PV T: UncertainLastUsableValue", ["T.PV"]),
    ],
)
def test_what_was_not_measured_is_an_empty_cell(
    tmp_path: Path, controller: Controller, quality: tuple[int, ...], reason: str, empty: list[str]
) -> None:
    names = columns(controller.manifest)
    journal = Journal(tmp_path / "loop.journal")
    journal.begin(controller.manifest, controller.sha256, 1e9, 1.0)
    for k in range(3):
        numbers = tuple(np.nan if name.startswith("mv ") else 0.0 for name in names)
        journal.scan(ScanEntry(1e9 + 0.5 * k, "HOLD", numbers, quality, reason))
    journal.close()
    export(tmp_path / "loop.journal", tmp_path / "loop.csv")
    table = pd.read_csv(tmp_path / "loop.csv").drop(columns=["time", "MODE"])
    assert [name for name in table if table[name].isna().all()] == empty
    assert table.drop(columns=empty).notna().all().all()


def test_of_dvs_that_are_not_all_read_none_is_believed_where_one_is_bad(tmp_path: Path, controller: Controller) -> None:
    m = replace(controller.manifest, dv=(Signal("a", "1", 0.0, 1.0), Signal("b", "1", 0.0, 1.0)))
    journal = Journal(tmp_path / "loop.journal")
    journal.begin(m, "", 1e9, 1.0)
    for k, status in enumerate((0, BAD, 0)):  # two PVs, an MV, and one of the two DVs
        quality = (0, 0, 0, status)
        journal.scan(ScanEntry(1e9 + 0.5 * k, "AUTO", (0.5,) * len(columns(m)), quality, ""))
    journal.close()
    export(tmp_path / "loop.journal", tmp_path / "loop.csv")
    table = pd.read_csv(tmp_path / "loop.csv")
    assert table[["a.DV", "b.DV"]].isna().to_numpy().tolist() == [[False] * 2, [True] * 2, [False] * 2]
    assert table[["level.PV", "T.PV", "valve.OP"]].notna().all().all()


def test_the_ranges_are_the_widest_of_all_runs(tmp_path: Path, controller: Controller) -> None:
    """After a swap to a narrower controller the readings of the wider one are still readings."""
    wide = controller.manifest
    (valve,), (level, temperature) = wide.mv, wide.pv
    narrow = replace(
        wide,
        pv=(replace(level, low=0.5, high=1.5), replace(temperature, unit="degC", low=0.0, high=50.0)),
        mv=(replace(valve, low=20.0),),
    )
    journal = Journal(tmp_path / "loop.journal")
    for m in (wide, narrow):
        journal.begin(m, controller.sha256, 1e9, 1.0)
    journal.close()
    tag_table(tmp_path / "loop.journal", tmp_path / "tags.csv")
    tags = {tag.tag: tag for tag in read_tags(tmp_path / "tags.csv")}
    ranges = {name: (tag.low, tag.high) for name, tag in tags.items()}
    assert ranges["level.PV"] == (level.low, level.high)
    assert ranges["T.PV"] == (0.0, 50.0)  # another unit: nothing to compare
    assert ranges["valve.OP"] == (valve.low, valve.high)
    assert (tags["valve.OP"].command_low, tags["valve.OP"].command_high) == (20.0, valve.high)
    assert tags["level.PV"].command_low is None
