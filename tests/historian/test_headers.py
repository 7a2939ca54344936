"""Tags and units of an export's header."""

from __future__ import annotations

from pathlib import Path

import pytest

from loopwright.pipeline.errors import RecordError
from loopwright.pipeline.historian.files.file_reader import read_export
from loopwright.pipeline.historian.files.headers import split_header, tags_of


@pytest.mark.parametrize(
    ("header", "tag", "unit"),
    [
        ("TIC-7.PV [degC]", "TIC-7.PV", "degC"),
        ("TIC-7.PV (°C)", "TIC-7.PV", "°C"),
        ("MIC-204.PV (%)", "MIC-204.PV", "%"),
        ("WI-201.PV (t/h)", "WI-201.PV", "t/h"),
        ("FI-7(kg/h)", "FI-7", "kg/h"),
        ("FI-8 (m³/h)", "FI-8", "m³/h"),
        ("FI-9 (m^3/h)", "FI-9", "m^3/h"),
        ("PI-3 (mbar)", "PI-3", "mbar"),
        ("QI-1 (kg/m2 s)", "QI-1", "kg/m2 s"),
        ("TI-7 (C)", "TI-7", "C"),
        ("TT-101 (C)", "TT-101", "C"),
        ("TICA-7 (C)", "TICA-7", "C"),
        ("T_out (C)", "T_out", "C"),
        ("Reactor T (K)", "Reactor T", "K"),
        ("42TIC204.PV (F)", "42TIC204.PV", "F"),
        (r"\\PI\U42:E-204/Outlet.Temp (C)", r"\\PI\U42:E-204/Outlet.Temp", "C"),
    ],
)
def test_a_unit_in_brackets_is_no_part_of_the_tag(header: str, tag: str, unit: str) -> None:
    assert split_header(header) == (tag, unit)


@pytest.mark.parametrize(
    "header",
    ["FI-7 (raw)", "P-101 (A)", "Tank 4 (C)", "TI-7 (A)", "TIC-7.PV (1)", "Level (north side)", "FI-7 ()", "FI-7"],
)
def test_other_brackets_are_part_of_the_tag(header: str) -> None:
    assert split_header(header) == (header, "")


def test_a_letter_among_others_is_no_unit() -> None:
    names = tags_of(["time", "T1 (A)", "T1 (B)", "T1 (C)", "T2 (C)"])
    assert [*names.values()] == ["time", "T1 (A)", "T1 (B)", "T1 (C)", "T2"]


def test_a_column_has_one_role(tmp_path: Path) -> None:
    path = tmp_path / "x.csv"
    path.write_text("time,TI-7 (C)\n0,1\n1,2\n")
    with pytest.raises(RecordError):
        read_export([path], ["TI-7", "TI-7 (C)"])


def test_a_series_has_the_name_that_a_person_gave_its_column(tmp_path: Path) -> None:
    path = tmp_path / "x.csv"
    path.write_text("time,TI-7 (C),FI-8 (m3/h)\n" + "".join(f"{k},{20 + k},{3 * k}\n" for k in range(5)))
    found = read_export([path], ["TI-7 (C)", "FI-8"]).series
    assert [*found] == ["TI-7 (C)", "FI-8"]
    assert [s.tag for s in found.values()] == ["TI-7 (C)", "FI-8"]
    assert found["TI-7 (C)"].value.tolist() == [20, 21, 22, 23, 24]
