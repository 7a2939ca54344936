"""Readings that look like another unit: left out of a historian's export, and kept where the unit is certain."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from dirty_plant import TAGS, answer, clean, screen_of

from loopwright.pipeline.errors import RecordError
from loopwright.pipeline.historian.cleaning.tag_checks import sentinels
from loopwright.pipeline.historian.cleaning.tags import Tag, named, read_tags
from loopwright.pipeline.historian.export_params import exported, signal_tags

CERTAIN = tuple(replace(tag, unit_certain=True) for tag in TAGS)


def jumping() -> np.ndarray:
    """A PV that a fault of the plant makes ten times as large for a while."""
    data = clean()
    pv = data.pv.copy()
    pv[700:760] *= 10
    return pv


def test_a_jump_by_a_conversion_is_left_out_unless_the_unit_is_certain(tmp_path: Path) -> None:
    data = clean().with_(pv=jumping())
    guessed = screen_of(data, tmp_path)
    assert guessed.report.tags[0].readings["unit_slip"] > 50
    kept = screen_of(data, tmp_path, CERTAIN)
    assert "unit_slip" not in kept.report.tags[0].readings


def test_so_is_an_mv_that_is_moved_to_a_hundredth_of_where_it_was(tmp_path: Path) -> None:
    data = clean()
    mv = data.mv.copy()
    mv[700:760] /= 100
    data = data.with_(mv=mv, pv=answer(mv, data.dv))
    guessed, kept = screen_of(data, tmp_path), screen_of(data, tmp_path, CERTAIN)
    assert guessed.report.tags[1].readings.get("unit_slip", 0) > 0
    assert "unit_slip" not in kept.report.tags[1].readings
    assert kept.report.kept_rows > guessed.report.kept_rows


def test_the_table_and_params_yaml_keep_it(tmp_path: Path) -> None:
    table = tmp_path / "tags.csv"
    table.write_text("tag,role,unit,unit_certain\nT,pv,degC,yes\nu,mv,%,no\nsp,sp,degC,\n")
    tags = read_tags(table)
    assert [tag.unit_certain for tag in tags] == [True, False, False]
    assert [tag.unit_certain for tag in signal_tags([exported(tag) for tag in named(tags)])] == [True, False, False]
    table.write_text("tag,role,unit,unit_certain\nT,pv,degC,perhaps\n")
    with pytest.raises(RecordError, match="unit_certain: 'perhaps' is neither yes nor no"):
        read_tags(table)


@pytest.mark.parametrize("cell", ["9" * 5001, '"' + "9" * 200_000 + '"'], ids=len)
def test_a_cell_of_thousands_of_digits_is_one_short_error(cell: str, tmp_path: Path) -> None:
    table = tmp_path / "tags.csv"
    table.write_text(f"tag,role,unit,low,high\nT,pv,degC,0,{cell}\n")
    with pytest.raises(RecordError) as caught:
        read_tags(table)
    assert len(str(caught.value)) < 300 + len(str(table))


def test_a_set_point_that_stands_far_from_the_others_for_a_while_is_no_code() -> None:
    """Few levels, one of them far away and held: a code for a missing value of a PV, not of a set point."""
    values = np.repeat([0.5, 0.52, 0.5, 0.51, 0.9, 0.52], [300, 300, 300, 300, 40, 300])
    assert sentinels(values, Tag("x", "pv"))[0].sum() == 40
    assert not sentinels(values, Tag("x", "sp"))[0].any()
    assert sentinels(np.where(values == 0.9, -9999.0, values), Tag("x", "sp"))[0].sum() == 40
