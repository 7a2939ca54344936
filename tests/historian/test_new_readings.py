"""An analyser's new readings among held and missing cells: which rows have one, and that no other row is lost."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
from analyser_plant import EVERY, NAMES, PERIOD_S, made, write_export

from loopwright.pipeline.config.exports import ExportParams
from loopwright.pipeline.config.known import Known
from loopwright.pipeline.errors import RecordError
from loopwright.pipeline.historian.analyser_readings import Aligned, of_samples
from loopwright.pipeline.historian.cleaning.new_readings import missing_readings, new_readings, on_rows, rows_between
from loopwright.pipeline.historian.cleaning.tags import Tag, named
from loopwright.pipeline.historian.export_params import exported, read_and_screen
from loopwright.pipeline.historian.files.export import Series
from loopwright.pipeline.historian.files.quality import Reason
from loopwright.pipeline.historian.screening import Screened
from loopwright.pipeline.records.record import Record

TAGS = (
    Tag(NAMES[0], "pv", "degC"),
    Tag(NAMES[1], "pv", "%", 0.0, 8.0, analyser=True),
    Tag(NAMES[2], "pv", "bar", constraint=True),
    Tag(NAMES[3], "mv", "%", 0.0, 100.0),
    Tag(NAMES[4], "mv", "%", 0.0, 100.0),
)


def series(values: list[float], code: list[int] | None = None, step_s: float = 10.0) -> Series:
    n = len(values)
    codes = np.zeros(n, np.uint8) if code is None else np.array(code, np.uint8)
    return Series("AI", step_s * np.arange(n), np.array(values), codes)


def screened(folder: Path, rows: int, *, missing: bool, tags: tuple[Tag, ...] = TAGS) -> Screened:
    path = folder / "x.csv"
    write_export(path, rows, 3, missing=missing)
    params = ExportParams(case="x", files=(path,), tags=tuple(map(exported, tags)), period_s=PERIOD_S)
    return read_and_screen(params, named(tags))


def test_a_held_value_is_no_reading_and_a_bad_cell_makes_none() -> None:
    bad = [0, 0, int(Reason.QUALITY), 0, 0, 0, 0, 0]
    found = new_readings(series([1.0, 1.0, 9.0, 1.0, 2.0, 2.0, 2.0, 3.0], bad), 10.0)
    assert found.time_s[found.good].tolist() == [0.0, 40.0, 70.0]
    assert np.count_nonzero(~found.good) == 1  # it stays for the account


def test_the_same_number_after_empty_cells_is_a_reading() -> None:
    empty = int(Reason.EMPTY)
    code = [0, empty, empty, empty, 0, empty, empty, empty, 0, empty]
    found = new_readings(series([1.0, 0, 0, 0, 1.0, 0, 0, 0, 2.0, 0], code), 10.0)
    assert found.time_s[found.good].tolist() == [0.0, 40.0, 80.0]


def test_a_reading_belongs_to_the_first_row_that_is_not_before_it() -> None:
    value, fresh = on_rows(series([1.0, 2.0, 4.0], step_s=25.0), 20.0 * np.arange(5))
    assert fresh.tolist() == [True, False, True, True, False]
    assert value.tolist() == [1.0, 1.5, 2.0, 4.0, 4.0]
    assert rows_between(np.arange(100) % 7 == 3) == 7


def test_readings_that_lack_are_counted_and_a_jitter_of_rows_is_none() -> None:
    rows = np.arange(0, 2_000, 20)
    fresh = np.zeros(2_000, dtype=np.bool_)
    fresh[np.delete(rows, [7, 30, 31, 32])] = True
    assert missing_readings(fresh) == 4
    late = np.zeros(2_000, dtype=np.bool_)
    late[rows[:-1] + np.random.default_rng(0).integers(0, 5, len(rows) - 1)] = True
    assert missing_readings(late) == 0


@pytest.mark.parametrize("missing", [False, True])
def test_screening_keeps_every_row_and_knows_the_new_readings(tmp_path: Path, missing: bool) -> None:
    found = screened(tmp_path, 1_500, missing=missing)
    _, _, read, fresh = made(1_500, 3)
    record = found.record
    assert len(record) == 1_500
    assert not found.report.dropped_rows
    assert list(record.seldom) == [1]
    rows = np.flatnonzero(record.seldom[1])
    if missing:
        assert rows.tolist() == np.flatnonzero(fresh).tolist()
    assert set(np.flatnonzero(fresh)) <= set(rows)
    assert len(rows) <= np.count_nonzero(fresh) + 1  # a held value at the beginning may be one
    assert record.pv[rows, 1] == pytest.approx(read[rows, 1], rel=1e-5)
    kinds = {f.kind for f in found.report.findings}
    said = [f.words for f in found.report.findings if f.kind == "analyser"]
    assert {f.tag for f in found.report.findings if f.kind == "analyser"} == {NAMES[1]}
    assert len(said) == 2
    assert f"{EVERY} rows ({EVERY * PERIOD_S:g} s)" in said[0]
    late = re.search(r"(\d+) rows? \((\d+) s\)", said[1])
    assert late is not None
    assert 0 < int(late[1]) <= 6
    assert int(late[2]) == PERIOD_S * int(late[1])
    assert not kinds & {"stuck", "saturated", "gaps"}


def test_the_quick_gains_of_an_analyser_have_their_sign(tmp_path: Path) -> None:
    found = screened(tmp_path, 3_000, missing=False)
    gain = {i.name: i.gain[NAMES[1]] for i in found.report.verdict.inputs}
    assert gain[NAMES[3]] == pytest.approx(0.030, rel=0.3)
    assert gain[NAMES[4]] == pytest.approx(0.045, rel=0.3)
    assert all(NAMES[1] not in i.first_answer_s for i in found.report.verdict.inputs)


def test_an_analyser_alone_or_one_that_is_quick_is_refused(tmp_path: Path) -> None:
    with pytest.raises(RecordError, match="no other process variable"):
        screened(tmp_path, 1_500, missing=False, tags=(TAGS[1], *TAGS[3:]))
    quick = (Tag(NAMES[0], "pv", "degC", analyser=True), TAGS[2], *TAGS[3:])
    with pytest.raises(RecordError, match="no analyser"):
        screened(tmp_path, 1_500, missing=False, tags=(Tag(NAMES[2], "pv", "bar"), quick[0], *TAGS[3:]))


def test_a_record_keeps_its_new_readings_in_its_file(tmp_path: Path) -> None:
    record = screened(tmp_path, 1_500, missing=True).record
    for name in ("record.parquet", "record.csv"):
        record.write(tmp_path / name)
        of = Record.read(tmp_path / name, _signals(record))
        assert of.fresh is not None
        assert record.fresh is not None
        assert (of.fresh == record.fresh).all()
        assert of.digest() == record.digest() != _without(record).digest()


def _signals(record: Record):  # type: ignore[no-untyped-def]
    from loopwright.pipeline.workbench.plant_data import signals_of

    return signals_of(record, 1)


def _without(record: Record) -> Record:
    return Record.of(_signals(record), record.pv, record.mv)


def test_values_between_readings_are_nearer_to_the_truth_than_held_ones_and_lines() -> None:
    from dataclasses import replace

    for seed in range(3):
        u, late, read, fresh = made(3_000, seed)
        record = _record(u, read)
        line = np.interp(np.arange(len(u)), np.flatnonzero(fresh), read[fresh, 1])
        seen = np.ones(read.shape, dtype=np.bool_)
        seen[:, 1] = fresh
        found = Aligned.of(replace(record, fresh=seen), 3)
        by = found.late[1]
        assert found.late[0] == found.late[2] == 0
        assert 0 < by <= 6  # 5 rows, and what its slow lags hide
        truth = late[by:, 1]
        errors = [_rms(of - truth) for of in (found.record.pv[: len(truth), 1], line[by:], read[by:, 1])]
        assert errors[0] < 0.75 * errors[1] < 0.5 * errors[2]
        assert found.record.fresh is not None
        assert (np.flatnonzero(found.record.fresh[:, 1]) % EVERY == (np.flatnonzero(fresh)[0] - by) % EVERY).all()


def _record(u: np.ndarray, read: np.ndarray) -> Record:
    from loopwright.pipeline.plants.simulator import Signals
    from loopwright.serving.manifest import Signal

    pv = tuple(Signal(n, "", -1e3, 1e3) for n in NAMES[:3])
    mv = tuple(Signal(n, "%", 0.0, 100.0) for n in NAMES[3:])
    return Record.of(Signals(PERIOD_S, pv[:2], pv, (), mv), read, u)


def _rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(values**2)))


def test_a_stated_dead_time_is_that_of_the_samples_without_the_lateness() -> None:
    stated = (Known("AI", "u", dead_s=(300.0, 420.0)), Known("TI", "u", dead_s=(0.0, 60.0)))
    late, as_it_is = of_samples(stated, {"AI": 6, "TI": 0}, 60.0)
    assert late.dead_s == (0.0, 60.0)
    assert as_it_is is stated[1]
