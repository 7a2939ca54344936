"""Records: what is written is read, and every fault of a file is one line with file, column and row."""

import dataclasses

import numpy as np
import pandas as pd
import pyarrow.parquet as pq
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from loopwright.pipeline.errors import RecordError
from loopwright.pipeline.plants.simulator import Signals
from loopwright.pipeline.records.record import Record, broken_run, position_in_run
from loopwright.serving.manifest import Signal

PV = (Signal("C_A", "mol/l", 0.0, 1.0), Signal("T", "K", 200.0, 600.0))
MV = (Signal("T_j", "K", 0.0, 500.0),)
DV = (Signal("T_in", "K", 200.0, 400.0),)
PLANT = Signals(0.5, sp=(), pv=PV, dv=(), mv=MV)


def make(runs: list[int], *, dv: tuple[Signal, ...] = (), seed: int = 0) -> Record:
    rng = np.random.default_rng(seed)
    n = sum(runs)
    run = np.repeat(np.arange(len(runs)), runs)
    return Record(
        0.5,
        PV,
        MV,
        dv,
        run,
        position_in_run(run) * 0.5,
        rng.uniform(0, 1, (n, 2)) * [1, 300] + [0, 250],
        rng.uniform(0, 500, (n, 1)),
        rng.uniform(200, 400, (n, len(dv))),
    )


def equal(a: Record, b: Record) -> bool:
    return all(np.array_equal(getattr(a, f.name), getattr(b, f.name)) for f in dataclasses.fields(Record))


@pytest.fixture
def frame() -> pd.DataFrame:
    """A good file of 8 rows: each test spoils it in one way."""
    rng = np.random.default_rng(3)
    return pd.DataFrame(
        {
            "time_s": np.arange(8) * 0.5,
            "C_A [mol/l]": rng.uniform(0, 1, 8),
            "T [K]": rng.uniform(250, 400, 8),
            "T_j [K]": rng.uniform(0, 500, 8),
        }
    )


def fault(path, frame: pd.DataFrame) -> str:
    """The one-line error of a file with these cells."""
    frame.to_csv(path, index=False) if path.suffix == ".csv" else frame.to_parquet(path)
    with pytest.raises(RecordError) as error:
        Record.read(path, PLANT)
    text = str(error.value)
    assert text.startswith(str(path))
    assert "\n" not in text
    return text.removeprefix(str(path))


# ---------------------------------------------------------------- round trips


@pytest.mark.parametrize("suffix", [".parquet", ".csv"])
@pytest.mark.parametrize("dv", [(), DV], ids=["no dv", "dv"])
def test_what_is_written_is_read(tmp_path, suffix, dv):
    record = make([5, 1, 7], dv=dv)
    path = tmp_path / "folder" / f"record{suffix}"
    record.write(path)
    again = Record.read(path, dataclasses.replace(PLANT, dv=dv))
    assert equal(record, again)
    assert record.digest() == again.digest()
    assert [p.name for p in path.parent.iterdir()] == [path.name]  # no draft stays


@settings(max_examples=25, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(values=arrays(np.float64, (6, 2), elements=st.floats(allow_nan=False, allow_infinity=False)))
def test_csv_keeps_every_bit(tmp_path, values):
    record = dataclasses.replace(make([6]), pv=values)
    record.write(tmp_path / "bits.csv")
    largest = np.finfo(float).max
    anything = tuple(Signal(s.name, s.unit, -largest, largest) for s in PV)
    assert np.array_equal(Record.read(tmp_path / "bits.csv", dataclasses.replace(PLANT, pv=anything)).pv, values)


def test_digest_sees_every_change():
    record = make([4, 4])
    others = [
        dataclasses.replace(record, pv=record.pv + 1e-12),
        dataclasses.replace(record, mv=record.mv[::-1].copy()),
        dataclasses.replace(record, run=np.repeat([0, 7], 4)),
        dataclasses.replace(record, period_s=0.25),
        dataclasses.replace(record, mv_signals=(Signal("T_j", "degC", 0.0, 500.0),)),
    ]
    assert len({r.digest() for r in (record, *others)}) == 6


def test_parquet_carries_signals_units_and_period(tmp_path):
    make([3]).write(tmp_path / "r.parquet")
    metadata = pq.read_schema(tmp_path / "r.parquet").metadata[b"loopwright.record"].decode()
    assert '"period_s": 0.5' in metadata
    assert '"unit": "mol/l"' in metadata


@pytest.mark.parametrize("back", [False, True])
def test_parquet_carries_whether_the_readings_showed_feedback(tmp_path, back):
    record = dataclasses.replace(make([3]), fed_back=back)
    record.write(tmp_path / "r.parquet")
    assert Record.read(tmp_path / "r.parquet", PLANT).fed_back is back
    assert record.digest() == make([3]).digest()


def test_failed_write_keeps_the_old_file(tmp_path, monkeypatch):
    path = tmp_path / "r.csv"
    make([3]).write(path)
    before = path.read_bytes()

    def disk_full(*_args, **_kwargs):
        raise OSError("no space left on device")

    monkeypatch.setattr(pd.DataFrame, "to_csv", disk_full)
    with pytest.raises(OSError, match="no space"):
        make([9]).write(path)
    assert path.read_bytes() == before
    assert list(tmp_path.iterdir()) == [path]


# ---------------------------------------------------------------- files that people drop in


def test_a_file_without_run_is_one_run(tmp_path, frame):
    frame.assign(time_s=frame.time_s + 3600.0, comment="ok").to_csv(tmp_path / "f.csv", index=False)
    record = Record.read(tmp_path / "f.csv", PLANT)
    assert record.run.tolist() == [0] * 8
    assert record.time_s.tolist() == (np.arange(8) * 0.5).tolist()
    assert np.array_equal(record.mv[:, 0], frame["T_j [K]"])


def test_spreadsheet_with_decimal_comma_byte_order_mark_and_blank_end(tmp_path, frame):
    frame.to_csv(tmp_path / "f.csv", index=False, sep=";", decimal=",", encoding="utf-8-sig")
    with (tmp_path / "f.csv").open("a") as file:
        file.write("\n;;;\n")
    assert np.allclose(Record.read(tmp_path / "f.csv", PLANT).pv[:, 0], frame["C_A [mol/l]"], rtol=1e-15)


def test_rounded_time_stamps_are_accepted(tmp_path, frame):
    frame.assign(time_s=frame.time_s + np.resize([0.0, 2e-4], 8)).to_csv(tmp_path / "f.csv", index=False)
    assert Record.read(tmp_path / "f.csv", PLANT).time_s.tolist() == (np.arange(8) * 0.5).tolist()


# ---------------------------------------------------------------- faults


def test_missing_column_names_the_nearest(tmp_path, frame):
    text = fault(tmp_path / "f.csv", frame.rename(columns={"T_j [K]": "Tj [K]"}))
    assert text.startswith(": column 'T_j [K]' is missing; the nearest is 'Tj [K]'")
    assert "the nearest is 'time'" in fault(tmp_path / "f.csv", frame.rename(columns={"time_s": "time"}))


def test_wrong_unit_says_which_was_found_and_which_is_wanted(tmp_path, frame):
    text = fault(tmp_path / "f.csv", frame.rename(columns={"C_A [mol/l]": "C_A [mmol/l]"}))
    assert "column 'C_A [mmol/l]' has the unit 'mmol/l'; 'mol/l' is wanted" in text
    text = fault(tmp_path / "f.csv", frame.rename(columns={"T [K]": "T"}))
    assert "column 'T' has no unit; 'K' is wanted" in text


@pytest.mark.parametrize(
    ("cell", "said"), [("", "is empty"), ("nan", "holds 'nan'"), ("inf", "holds 'inf'"), ("off", "holds 'off'")]
)
def test_a_cell_that_is_no_number_is_named_by_its_line(tmp_path, frame, cell, said):
    text = fault(tmp_path / "f.csv", frame.astype({"T [K]": object}).replace({"T [K]": {frame["T [K]"][4]: cell}}))
    # Four rows stand before it, and the header is line 1.
    assert text.startswith(f": column 'T [K]', line 6 {said}")


def test_parquet_rows_count_from_zero(tmp_path, frame):
    frame.loc[4, "T [K]"] = np.nan
    assert fault(tmp_path / "f.parquet", frame).startswith(": column 'T [K]', row 4 holds 'nan'")
    text = fault(tmp_path / "f.parquet", frame.assign(time_s=pd.Timestamp("2024-01-01")))
    assert text.startswith(": column 'time_s' holds dates")


def test_gap_in_time(tmp_path, frame):
    text = fault(tmp_path / "f.csv", frame.drop(index=3))
    assert text.startswith(": column 'time_s', line 5: time steps by 1 s where 0.5 s is wanted")
    assert "column 'run'" in text


def test_other_period_than_the_plant(tmp_path, frame):
    text = fault(tmp_path / "f.csv", frame.assign(time_s=np.arange(8) * 2.0))
    assert "line 3: time steps by 2 s where 0.5 s is wanted; the file is sampled every 2 s" in text


def test_runs_in_pieces_or_with_odd_numbers(tmp_path, frame):
    text = fault(tmp_path / "f.csv", frame.assign(run=[0, 0, 1, 1, 1, 0, 0, 0]))
    assert text.startswith(": column 'run', line 7: run 0 goes on here after another run")
    assert "line 2: 0.5 is not a run number" in fault(tmp_path / "f.csv", frame.assign(run=0.5))


def test_constant_mv_is_named(tmp_path, frame):
    text = fault(tmp_path / "f.csv", frame.assign(**{"T_j [K]": 250.0}))
    assert text.startswith(": column 'T_j [K]': the MV T_j is 250 K in every row")


def test_mv_outside_its_range(tmp_path, frame):
    frame.loc[2, "T_j [K]"] = 500.1
    assert "line 4: 500.1 is outside the MV's range 0 to 500 K" in fault(tmp_path / "f.csv", frame)
    frame.loc[2, "T_j [K]"] = 500.0 + 1e-8
    frame.loc[2, "T [K]"] = 1e4  # a measured PV may stray
    frame.to_csv(tmp_path / "f.csv", index=False)
    assert Record.read(tmp_path / "f.csv", PLANT).pv[2, 1] == 1e4


def test_a_pv_in_another_unit_is_found_by_its_range(tmp_path, frame):
    frame["C_A [mol/l]"] *= 1000  # mmol/l under the old name
    text = fault(tmp_path / "f.csv", frame)
    assert "like most of its column, is outside the PV's range" in text
    assert "C_A" in text
    assert "check the unit" in text


def test_a_discrete_mv_has_its_allowed_values_only(tmp_path, frame):
    valve = Signal("valve", "-", 1.0, 2.0, values=(1.0, 2.0))
    frame["valve [-]"] = [1, 1, 2, 2, 1, 2, 1 + 1e-12, 2]
    frame.to_csv(tmp_path / "f.csv", index=False)
    with_valve = dataclasses.replace(PLANT, mv=(*MV, valve))
    assert Record.read(tmp_path / "f.csv", with_valve).mv[3, 1] == 2
    frame.loc[4, "valve [-]"] = 1.5
    frame.to_csv(tmp_path / "f.csv", index=False)
    with pytest.raises(RecordError, match=r"line 6: 1\.5 is none of the values \[1\.0, 2\.0\] that valve may have"):
        Record.read(tmp_path / "f.csv", with_valve)


def test_files_that_are_no_tables(tmp_path, frame):
    for name, text, said in (
        ("a.csv", "", "cannot be read as csv"),
        ("b.csv", ",".join(frame.columns), "no rows of data"),
        ("c.csv", "a,b\n1,2\n1,2,3\n", "line 3, saw 3"),
        ("d.parquet", "not parquet at all", "cannot be read as parquet"),
        ("e.xlsx", "x", "kept as .parquet or .csv, not as '.xlsx'"),
        ("f.csv", "time_s,time_s\n0,0\n", "'time_s' stands twice"),
    ):
        path = tmp_path / name
        path.write_text(text)
        with pytest.raises(RecordError, match=said):
            Record.read(path, PLANT)
    with pytest.raises(RecordError, match="no such file"):
        Record.read(tmp_path / "absent.csv", PLANT)
    with pytest.raises(RecordError, match=r"kept as \.parquet or \.csv"):
        make([3]).write(tmp_path / "r.json")


def test_arrays_that_do_not_fit_are_refused():
    record = make([4])
    with pytest.raises(RecordError, match=r"pv has shape \(4, 1\); 4 rows and its signals need \(4, 2\)"):
        dataclasses.replace(record, pv=record.pv[:, :1])
    with pytest.raises(RecordError, match="time_s has shape"):
        dataclasses.replace(record, time_s=record.time_s[:3])
    with pytest.raises(RecordError, match="run 0 goes on at row 3"):
        dataclasses.replace(record, run=np.array([0, 1, 1, 0]))


# ---------------------------------------------------------------- runs


@settings(max_examples=60, deadline=None)
@given(runs=st.lists(st.integers(1, 6), min_size=1, max_size=6), length=st.integers(1, 7))
def test_starts_are_all_rows_with_room_in_their_run(runs, length):
    record = make(runs)
    wanted = [k for k in range(len(record) - length) if record.run[k] == record.run[k + length]]
    if wanted:
        assert record.starts(length).tolist() == wanted
    else:
        with pytest.raises(RecordError, match=f"the longest run has {max(runs)} rows, too short for the lags"):
            record.starts(length)


@given(run=st.lists(st.integers(0, 3), max_size=12))
def test_broken_run_is_the_first_return(run):
    first = next((i for i in range(1, len(run)) if run[i] != run[i - 1] and run[i] in run[:i]), None)
    assert broken_run(np.array(run, dtype=np.int64)) == first
