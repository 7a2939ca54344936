"""Ways in which programs write numbers: signs, thousands, decimals, units behind them."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest
from dirty_plant import cells, clean, screen, write
from hypothesis import given, settings
from hypothesis import strategies as st

from loopwright.pipeline.errors import RecordError
from loopwright.pipeline.historian.files.dialect import sniff
from loopwright.pipeline.historian.files.file_reader import read_export
from loopwright.pipeline.historian.files.numbers import loose_number, numbers

MINUSES = ["-", "\u2212", "\u2013", "\u2010", "\u2011", "\ufe63", "\uff0d", "\u2212\u00a0", "- "]
THOUSANDS = ["", "\u00a0", "\u202f", "\u2009", " ", "'", "’"]


@pytest.mark.parametrize("minus", MINUSES)
@pytest.mark.parametrize("between", THOUSANDS)
@pytest.mark.parametrize("decimal", [".", ","])
def test_signs_blanks_and_apostrophes(minus: str, between: str, decimal: str) -> None:
    column = [f"{minus}1{between}234{between}567{decimal}5", f"{minus}12{decimal}25", f"\u00a07{decimal}5\u202f", "3"]
    values, codes, texts = numbers(pa.array(column), decimal)
    np.testing.assert_allclose(values, [-1_234_567.5, -12.25, 7.5, 3])
    assert not codes.any()
    assert not texts


@settings(max_examples=60, deadline=None)
@given(
    st.lists(st.floats(-1e7, 1e7).map(lambda v: round(v, 3)), min_size=1, max_size=20),
    st.sampled_from(MINUSES), st.sampled_from([*THOUSANDS, "the other"]), st.sampled_from([".", ","]),
    st.integers(1, 3),
)  # fmt: skip
def test_every_way_to_write_a_number_gives_it_back(
    values: list[float], minus: str, between: str, decimal: str, digits: int
) -> None:
    group = between if between != "the other" else {".": ",", ",": "."}[decimal]
    plain = [f"{v:,.{digits}f}" for v in values]
    column = [t.replace(",", "#").replace(".", decimal).replace("#", group).replace("-", minus) for t in plain]
    found, codes, _ = numbers(pa.array(column), decimal)
    assert not codes.any(), column
    np.testing.assert_allclose(found, [float(t.replace(",", "")) for t in plain])


@pytest.mark.parametrize(
    ("column", "decimal", "expected"),
    [
        (["1,250", "64,34", "70.1"], ".", [None, None, 70.1]),  # 1,250 may be either beside 64,34
        (["1,250", "1,234.5", "70.1"], ".", [1250, 1234.5, 70.1]),
        (["1.250", "64.34", "70,1"], ",", [None, None, 70.1]),
        (["1.250", "1.234,5", "70,1"], ",", [1250, 1234.5, 70.1]),
        (["5.2-", "\u2014", "–", "1.#QNAN"], ".", [-5.2, None, None, None]),
    ],
)
def test_what_may_be_two_numbers_is_none(column: list[str], decimal: str, expected: list[float | None]) -> None:
    values, _, _ = numbers(pa.array(column), decimal)
    np.testing.assert_allclose(values, [np.nan if v is None else v for v in expected])


@pytest.mark.parametrize(
    ("content", "decimal"),
    [
        ('time,a,b\n0,"1,234","998"\n1,"1,250","999"\n2,"1,260","997"\n', "."),
        ("time;a;b\n0;1,234;5\n1;1,250;5\n2;998;6\n", "."),
        ("time;a;b\n0;1,234;5\n1;1,250;5\n2;1,260;6\n", ","),
        ("time;a;b\n0;0,234;5\n1;1,250;5\n2;998;6\n", ","),
        ('time,a,b\n0,"1,5","2,5"\n1,"2,5","3,25"\n2,"2,5","3,5"\n', ","),
        ("time;a;b\n0;1'234,5;5\n1;1'250,5;5\n2;\u221212,5;6\n", ","),
        ("time;a;b\n0;1.234;5\n1;1.250;5\n2;998;6\n", ","),
        ("time;a;b\n0;1.234;5\n1;1.250;5\n2;1.260;6\n", "."),
        ("time;a;b\n0;45.125;5\n1;99.250;5\n2;100;6\n", "."),
        ("time;a;b\n0;45,125;5\n1;99,250;5\n2;100;6\n", ","),
        ("time;a;b\n0;1.234;5\n1;1.250;5\n2;999;6\n3;0;6\n", "."),
        ("time;a;b\n0;1.234;5\n1;1.250;5\n2;500;6\n3;0;6\n", "."),
        ("time;a;b\n0;1.234;45.125\n1;1.250;5.125\n2;998;6.125\n", ","),
        ("time;a;b\n0;1.234.567;5\n1;998;5\n", ","),
    ],
)
def test_the_sign_between_thousands_is_no_decimal_sign(content: str, decimal: str, tmp_path: Path) -> None:
    path = tmp_path / "x.csv"
    path.write_text(content, encoding="utf-8")
    assert sniff(path).decimal == decimal


@pytest.mark.parametrize(
    ("column", "expected"),
    [
        (["60.3 %", "61.5 %", "", "Bad"], [60.3, 61.5, None, None]),
        (["60.3%", "7%"], [60.3, 7]),
        (["-3.5 °C", "1,234.5 °C"], [-3.5, 1234.5]),
        (["60.3 %", "61.5 kg"], [None, None]),
        (["60.3 %", "61.5"], [None, 61.5]),
        (["5A", "7A"], [None, None]),
        (["1 Running", "2 Running"], [None, None]),
    ],
)
def test_a_unit_behind_every_number(column: list[str], expected: list[float | None]) -> None:
    values, _, _ = numbers(pa.array(column))
    np.testing.assert_allclose(values, [np.nan if v is None else v for v in expected])


@pytest.mark.parametrize("sign", [".", ","])
def test_a_small_number_far_below_tells_thousands(sign: str, tmp_path: Path) -> None:
    values = [1000 + k for k in range(300)] + [998]
    own = [[str(1_709_532_000 + 10 * k), f"{v:,d}".replace(",", sign)] for k, v in enumerate(values)]
    path = write(tmp_path / "x.csv", own, ("time", "a"), sep=";")
    np.testing.assert_allclose(read_export([path]).series["a"].value, values)


def test_three_digits_behind_both_signs_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "x.csv"
    path.write_text("time;a;b\n0;1,234;1.234\n1;1,250;1.250\n")
    with pytest.raises(RecordError, match=r"1,250 and 1\.250 may be decimals or thousands; export numbers without"):
        read_export([path])


@pytest.mark.parametrize(
    ("text", "number"),
    [
        ("(5.2)", 5.2),
        ("< 0,5", 0.5),
        (">100", 100),
        ("- 7 *", -7),
        ("bad", None),
        ("1;2", None),
        ("[-11059] No Good Data", None),
        ("Error 254", None),
        ("over 100", 100),
        ("Low: 2", 2),
        ("7 degC", 7),
    ],
)
def test_the_number_that_a_text_shows(text: str, number: float | None) -> None:
    assert loose_number(text) == number


ONE_SIDED: dict[str, Callable[[float], str]] = {
    "in brackets": lambda v: f"({v - 50:.3f})" if v < 50 else f"{v:.3f}",
    "below a limit": lambda v: "<50" if v < 50 else f"{v:.3f}",
    "over a range": lambda v: "Over Range" if v > 60 else f"{v:.3f}",
}


@pytest.mark.parametrize("name", ONE_SIDED)
def test_a_side_that_was_refused_as_text_makes_a_record_doubtful(name: str, tmp_path: Path) -> None:
    data = clean()
    own = [[row[0], ONE_SIDED[name](float(v)), *row[2:]] for v, row in zip(data.pv, cells(data), strict=True)]
    report = screen(write(tmp_path / "x.csv", own)).report
    assert "one_sided" in {f.kind for f in report.findings}
    assert report.verdict.carries != "yes"


@pytest.mark.parametrize("minus", ["\u2212", "–"])
def test_a_side_written_with_another_minus_is_read(minus: str, tmp_path: Path) -> None:
    data = clean()
    own = [[r[0], f"{v - 50:.3f}".replace("-", minus), *r[2:]] for v, r in zip(data.pv, cells(data), strict=True)]
    found = screen(write(tmp_path / "x.csv", own))
    assert found.report.findings == ()
    np.testing.assert_allclose(found.record.pv[:, 0], data.pv - 50, atol=1e-3)
    assert found.report.verdict.carries == "yes"
