"""The damages of real exports: each is named, masked where it must be, and does not reach the record."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from dirty_plant import PERIOD_S, TAGS, Clean, cells, clean, screen, screen_of, write

from loopwright.pipeline.errors import RecordError
from loopwright.pipeline.historian.cleaning.tags import Tag
from loopwright.pipeline.historian.files.quality import Reason
from loopwright.pipeline.historian.screening import Screened

SEED = np.random.default_rng(5)
SPOT = SEED.choice(np.arange(60, 1440), 20, replace=False)


def at(values: np.ndarray, rows: object, new: object) -> np.ndarray:
    out = values.copy()
    out[rows] = new
    return out


def kinds(found: Screened) -> set[str]:
    return {f.kind for f in found.report.findings}


def accounted(found: Screened) -> None:
    """Every reading and every row has one reason."""
    r = found.report
    assert r.kept_rows + sum(r.dropped_rows.values()) == r.grid_rows == len(found.grid)
    assert len(found.record) == r.kept_rows
    for tag in r.tags:
        assert sum(tag.readings.values()) == len(found.series[tag.tag])
        assert sum(tag.readings.values()) == r.file_rows - r.unreadable_rows - r.timeless_rows


def worst_error(found: Screened, truth: Clean) -> float:
    """Largest difference of the kept PV to the clean one, at the same times."""
    kept = np.flatnonzero(found.code == 0)
    expected = np.interp(found.grid.time_s[kept], truth.time_s, truth.pv)
    return float(np.max(np.abs(found.record.pv[:, 0] - expected)))


def stuck(d: Clean) -> Clean:
    return d.with_(pv=at(d.pv, slice(600, 800), d.pv[600]))


DROPPED: dict[str, tuple[Callable[[Clean], Clean], str, str]] = {
    "-9999": (lambda d: d.with_(pv=at(d.pv, SPOT, -9999.0)), "sentinel", "pv"),
    "one -9999": (lambda d: d.with_(pv=at(d.pv, SPOT[:1], -9999.0)), "sentinel", "pv"),
    "a code of one's own": (lambda d: d.with_(pv=at(d.pv, SPOT, 7777.0)), "sentinel", "pv"),
    "zero of a dead sensor": (lambda d: d.with_(pv=at(d.pv, SPOT, 0.0)), "sentinel", "pv"),
    "zero for a while": (lambda d: d.with_(pv=at(d.pv, slice(300, 380), 0.0)), "sentinel", "pv"),
    "-9999 in the MV": (lambda d: d.with_(mv=at(d.mv, SPOT, -9999.0)), "sentinel", "mv"),
    "1 % outliers": (lambda d: d.with_(pv=at(d.pv, SPOT, d.pv[SPOT] + 25.0)), "outlier", "pv"),
    "small outliers": (lambda d: d.with_(pv=at(d.pv, SPOT, d.pv[SPOT] - 8.0)), "outlier", "pv"),
    "outliers on slopes": (lambda d: d.with_(pv=at(d.pv, SPOT, d.pv[SPOT] - 3.0)), "outlier", "pv"),
    "stuck for 200 rows": (stuck, "stuck", "pv"),
    "degF for a while": (
        lambda d: d.with_(pv=at(d.pv, slice(400, 470), 1.8 * d.pv[400:470] + 32)), "unit_slip", "pv",
    ),
    "a thousandth for a while": (
        lambda d: d.with_(dv=at(d.dv, slice(400, 470), d.dv[400:470] / 1000)), "unit_slip", "dv",
    ),
    "the other unit to the end": (
        lambda d: d.with_(pv=at(d.pv, slice(1200, None), d.pv[1200:] + 273.15)), "unit_slip", "pv",
    ),
    "degF for two whiles": (
        lambda d: d.with_(pv=at(d.pv, np.r_[200:500, 900:1200], 1.8 * d.pv[np.r_[200:500, 900:1200]] + 32)),
        "unit_slip", "pv",
    ),
    "the sign turned": (lambda d: d.with_(pv=at(d.pv, slice(400, 520), -d.pv[400:520])), "unit_slip", "pv"),
    "the MV as a fraction": (
        lambda d: d.with_(mv=at(d.mv, slice(400, 700), d.mv[400:700] / 100)), "unit_slip", "mv",
    ),
    "a block again": (
        lambda d: d.with_(pv=at(d.pv, slice(1100, 1250), d.pv[300:450]), mv=at(d.mv, slice(1100, 1250), d.mv[300:450])),
        "copy", "pv",
    ),
    "pulses of the MV": (lambda d: d.with_(mv=at(d.mv, SPOT, np.where(d.mv[SPOT] > 50, 21.0, 79.0))), "outlier", "mv"),
    "saturated": (lambda d: d.with_(pv=np.minimum(d.pv, np.quantile(d.pv, 0.8))), "saturated", "pv"),
}  # fmt: skip


@pytest.mark.parametrize("name", DROPPED)
def test_damage_is_masked_and_does_not_reach_the_record(name: str, tmp_path: Path) -> None:
    spoil, kind, _ = DROPPED[name]
    data = clean()
    found = screen_of(spoil(data), tmp_path)
    accounted(found)
    assert kind in kinds(found), found.report.findings
    assert any(f.drops for f in found.report.findings if f.kind == kind)
    assert worst_error(found, data) < 2.5  # what a line over two rows of a moving plant misses
    assert len(found.record) > 700
    assert np.all((found.record.mv >= 20) & (found.record.mv <= 80))


def test_a_clean_export_loses_nothing(tmp_path: Path) -> None:
    data = clean()
    found = screen_of(data, tmp_path)
    accounted(found)
    assert found.report.findings == ()
    assert found.report.dropped_rows == {}
    assert found.report.period_s == PERIOD_S
    assert found.report.verdict.carries == "yes", found.report.verdict.reasons
    np.testing.assert_allclose(found.record.pv[:, 0], data.pv)
    np.testing.assert_allclose(found.record.mv[:, 0], data.mv)
    np.testing.assert_allclose(found.record.dv[:, 0], data.dv)


@pytest.mark.parametrize("word", ["Bad Input", "I/O Timeout", "#WERT!", "nan", "inf", "1,2,3"])
def test_text_is_counted_and_bridged(word: str, tmp_path: Path) -> None:
    data = clean()
    rows = cells(data)
    for k in SPOT:
        rows[k][1] = word
    found = screen(write(tmp_path / "x.csv", rows))
    accounted(found)
    readings = found.report.tags[0].readings
    assert readings["empty" if word == "nan" else "text"] == len(SPOT)
    assert worst_error(found, data) < 2.5
    assert found.report.tags[0].rows_bridged + found.report.tags[0].readings.get("gap", 0) >= len(SPOT) - 2


def test_all_faults_at_once(tmp_path: Path) -> None:
    data = clean(3000)
    pv = at(data.pv, slice(600, 800), data.pv[600])
    pv = at(pv, SPOT[:10] + 1440, -9999.0)
    pv = at(pv, np.arange(1500, 1560, 9), pv[1500:1560:9] + 30)
    pv = at(pv, slice(2000, 2080), 1.8 * pv[2000:2080] + 32)
    found = screen_of(data.with_(pv=pv, dv=np.round(data.dv / 10) * 10), tmp_path)
    accounted(found)
    assert {"stuck", "sentinel", "outlier", "unit_slip", "quantization"} <= kinds(found)
    assert worst_error(found, data) < 2.5


@pytest.mark.parametrize(
    ("name", "spoil", "kind", "tag"),
    [
        ("quantized", lambda d: d.with_(pv=np.round(d.pv / 0.5) * 0.5), "quantization", "TIC-101.PV"),
        ("MV late by three rows", lambda d: d.with_(mv=np.r_[np.full(5, d.mv[0]), d.mv[:-5]]), "shifted", "TIC-101.OP"),
        ("drift", lambda d: d.with_(pv=d.pv + np.linspace(0, 25, len(d.pv))), "drift", "TIC-101.PV"),
        ("a jump", lambda d: d.with_(pv=d.pv + 5 * (np.arange(len(d.pv)) > 1400)), "drift", "TIC-101.PV"),
        (
            "swinging door", lambda d: d.with_(pv=np.interp(d.time_s, d.time_s[::25], d.pv[::25])),
            "compression", "TIC-101.PV",
        ),
    ],
)  # fmt: skip
def test_what_is_named_and_kept(
    name: str, spoil: Callable[[Clean], Clean], kind: str, tag: str, tmp_path: Path
) -> None:
    found = screen_of(spoil(clean(3000)), tmp_path)
    accounted(found)
    named = [f for f in found.report.findings if f.kind == kind]
    assert named, found.report.findings
    assert tag in named[0].tag
    assert not named[0].drops
    assert len(found.record) > 2800


def test_values_that_stand_give_rows_as_long_unless_a_period_is_given(tmp_path: Path) -> None:
    """An analyser's value in each of five rows: a model of single rows would hold still, and nothing seem to answer."""
    data = clean(3000)
    data = data.with_(pv=np.repeat(data.pv[::5], 5))
    found, given = screen_of(data, tmp_path), screen_of(data, tmp_path, period_s=PERIOD_S)
    for screened_one, rows, period_s in ((found, 600, 5 * PERIOD_S), (given, 3000, PERIOD_S)):
        accounted(screened_one)
        assert "repeated" in kinds(screened_one)
        assert screened_one.report.period_s == period_s
        assert 0.93 * rows < len(screened_one.record) <= rows
    assert found.report.verdict.carries == "yes", found.report.verdict.reasons


def test_a_true_step_and_a_true_peak_are_no_damage(tmp_path: Path) -> None:
    """A fast process jumps, and a sharp answer to a pulse of the MV stays: the linear model explains it."""
    random = np.random.default_rng(1)
    data = clean()
    mv = data.mv.copy()
    mv[100::100] += 15.0
    pv = np.round(np.r_[40.0, 20 + 0.9 * mv[:-1]] + random.normal(0, 0.1, len(mv)), 3)
    found = screen_of(data.with_(pv=pv, mv=mv), tmp_path)
    accounted(found)
    assert found.report.kept_rows >= 0.99 * found.report.grid_rows
    assert worst_error(found, data.with_(pv=pv)) < 1.0


def test_jitter_duplicates_shuffle_and_gaps(tmp_path: Path) -> None:
    random = np.random.default_rng(2)
    data = clean()
    n = len(data.pv)
    jittered = data.with_(time_s=data.time_s + random.uniform(-0.3, 0.3, n))
    rows = cells(jittered)
    rows = [row for k, row in enumerate(rows) if not 700 <= k < 760] + rows[40:50]
    random.shuffle(rows)
    found = screen(write(tmp_path / "x.csv", rows))
    accounted(found)
    r = found.report
    assert r.period_s == PERIOD_S
    assert (r.gaps, r.runs) == (1, 2)
    assert r.gap_s == pytest.approx(60 * PERIOD_S, abs=2 * PERIOD_S)
    assert r.tags[0].readings["duplicate"] == 10
    assert len(found.record) == n - 60
    assert np.array_equal(found.record.mv[:, 0], np.delete(data.mv, slice(700, 760)))  # jitter shifts no move
    assert worst_error(found, data) < 2.5


def test_nothing_is_drawn_over_more_than_the_hold(tmp_path: Path) -> None:
    data = clean()
    pv = at(at(data.pv, slice(300, 302), np.nan), slice(500, 512), np.nan)
    short = screen_of(data.with_(pv=pv), tmp_path)
    assert short.report.dropped_rows == {"empty": 12}
    assert short.report.tags[0].rows_bridged == 2
    assert short.report.runs == 2
    longer = screen_of(data.with_(pv=pv), tmp_path, hold_s=100.0)
    assert longer.report.dropped_rows == {}
    none = screen_of(data.with_(pv=pv), tmp_path, hold_s=PERIOD_S)
    assert none.report.dropped_rows == {"empty": 14}


def test_modes_are_counted_and_left_out_on_request(tmp_path: Path) -> None:
    data = clean()
    rows = [[*row, "AUTO" if 200 <= k < 900 else "MAN"] for k, row in enumerate(cells(data))]
    header = ("timestamp", *(t.tag for t in TAGS), "TIC-101.MODE")
    path = write(tmp_path / "x.csv", rows, header)
    tags = (*TAGS, Tag("TIC-101.MODE", "mode"))
    found = screen(path, tags)
    assert found.report.modes == {"TIC-101.MODE": {"MAN": 800, "AUTO": 700}}
    assert found.report.dropped_rows == {}
    without = screen(path, tags, without_modes=["AUTO"])
    assert without.report.dropped_rows == {"mode": 700}
    assert without.report.runs == 2
    with pytest.raises(RecordError, match="has the modes MAN, AUTO"):
        screen(path, tags, without_modes=["CAS"])


def test_quality_counts(tmp_path: Path) -> None:
    data = clean()
    rows = [[*row, "Bad" if k in SPOT else "Good"] for k, row in enumerate(cells(data))]
    for k in SPOT:
        rows[k][1] = "3.3"
    header = ("timestamp", *(t.tag for t in TAGS), "TIC-101.PV Quality")
    found = screen(write(tmp_path / "x.csv", rows, header))
    accounted(found)
    assert found.report.tags[0].readings["quality"] == len(SPOT)
    assert worst_error(found, data) < 2.5


def test_a_wrong_range_is_refused(tmp_path: Path) -> None:
    tags = (Tag("TIC-101.PV", "pv", "K", 300, 400), *TAGS[1:])
    with pytest.raises(RecordError, match=r"outside its range 300 to 400 K; correct the range or the unit"):
        screen_of(clean(), tmp_path, tags)


def test_rows_torn_out_by_a_narrow_range_make_a_record_doubtful(tmp_path: Path) -> None:
    narrow = (Tag("TIC-101.PV", "pv", "degC", 50, 90), *TAGS[1:])
    verdict = screen_of(clean(), tmp_path, narrow).report.verdict
    assert verdict.carries == "doubtful"
    assert re.search(
        r"[1-4]\d % of the rows have a reading outside the range that was given: widen", verdict.reasons[-1]
    )
    assert screen_of(clean(), tmp_path).report.verdict.carries == "yes"


def test_a_constant_mv_and_regulation_without_excitation_are_told(tmp_path: Path) -> None:
    data = clean()
    still = screen_of(data.with_(mv=np.full(len(data.mv), 40.0)), tmp_path)
    assert still.report.verdict.carries == "no"
    assert "made 0 moves" in " ".join(still.report.verdict.reasons)
    random = np.random.default_rng(3)
    n = 2000
    y, u, load = np.zeros(n), np.zeros(n), 0.0
    for k in range(n - 1):  # a PI loop at one set point
        y[k] += random.normal(0, 0.02)
        u[k] = (u[k - 1] if k else 0.0) - 0.8 * (y[k] - y[k - 1]) - 0.1 * y[k]
        load = 0.98 * load + random.normal(0, 0.05)
        y[k + 1] = 0.9 * y[k] + 0.1 * u[k] + load * 0.1
    u[-1] = u[-2]
    loop = data.with_(time_s=data.time_s[0] + PERIOD_S * np.arange(n), pv=60 + y, mv=50 + u, dv=steps_of(n))
    verdict = screen_of(loop, tmp_path).report.verdict
    assert verdict.carries == "no"
    assert "TIC-101.OP follows TIC-101.PV" in verdict.reasons[0]


def steps_of(n: int) -> np.ndarray:
    return 500 + 20 * np.sign(np.sin(np.arange(n) / 40.0)) + 0.01 * np.random.default_rng(4).normal(size=n)


def test_inputs_that_move_together_are_told(tmp_path: Path) -> None:
    data = clean()
    found = screen_of(
        data.with_(dv=3 * data.mv + 100 + np.random.default_rng(0).normal(0, 0.3, len(data.mv))), tmp_path
    )
    assert found.report.verdict.carries == "no"
    assert "cannot be told apart" in " ".join(found.report.verdict.reasons)


def test_exception_reports_with_a_dead_band_are_held(tmp_path: Path) -> None:
    """In the long format: nothing is stuck, and no line through a hold answers before the MV moves."""
    data = clean(3000)
    rows = []
    for name, values, band in zip([t.tag for t in TAGS], (data.pv, data.mv, data.dv), (0.3, 1e-9, 2.0), strict=True):
        last = np.inf
        for t, v in zip(data.time_s, values, strict=True):
            if abs(v - last) > band:
                rows.append([name, f"{t:.0f}", f"{v}"])
                last = v
    path = write(tmp_path / "x.csv", rows, ("tag", "time", "value"))
    found = screen(path, period_s=PERIOD_S, hold_s=3600.0)
    assert kinds(found) == {"compression"}, found.report.findings
    assert found.report.kept_rows > 2900
    assert worst_error(found, data) < 0.4
    assert found.report.verdict.carries == "yes"


def test_a_dead_sensor_with_noise_is_masked_but_for_its_edges(tmp_path: Path) -> None:
    data = clean()
    flat = 50 + np.random.default_rng(2).normal(0, 0.1, 250).round(3)
    found = screen_of(data.with_(pv=at(data.pv, slice(500, 750), flat)), tmp_path)
    accounted(found)
    lost = found.code == Reason.UNLIKE
    assert lost[500:750].mean() > 0.9
    assert lost[:480].sum() + lost[770:].sum() == 0


def test_a_frozen_mv_is_masked_over_its_whole_rest(tmp_path: Path) -> None:
    """The PV goes on answering to the true valve: rows 500 to 750, of which nothing shows the moves."""
    data = clean()
    found = screen_of(data.with_(mv=at(data.mv, slice(500, 750), data.mv[500])), tmp_path)
    accounted(found)
    assert "unlike" in kinds(found)
    lost = np.flatnonzero(found.code == Reason.UNLIKE)
    assert 500 - 60 <= lost[0] <= 510
    assert 740 <= lost[-1] <= 755


def test_a_gain_that_changes_over_the_range_is_no_contradiction(tmp_path: Path) -> None:
    """A third of the gain above 60 %, and none above 72 %: it is the plant, and every row stays."""
    data, random = clean(), np.random.default_rng(0)
    u = np.minimum(data.mv, 72.0)
    target, y = 20 + 0.8 * np.minimum(u, 60) + 0.27 * np.maximum(u - 60, 0), np.full(len(u), 50.0)
    for k in range(len(u) - 1):
        y[k + 1] = y[k] + 0.1 * (target[max(k - 2, 0)] - y[k])
    found = screen_of(data.with_(pv=np.round(y + random.normal(0, 0.1, len(u)), 3)), tmp_path)
    accounted(found)
    assert not {"unlike", "stuck"} & kinds(found), found.report.findings
    assert found.report.kept_rows == found.report.grid_rows


def test_stamps_to_the_minute_are_spread(tmp_path: Path) -> None:
    data = clean()
    found = screen_of(data.with_(time_s=np.floor(data.time_s / 60) * 60), tmp_path)
    accounted(found)
    assert "rounded" in kinds(found)
    assert found.report.period_s == PERIOD_S
    assert len(found.record) == len(data.pv)
    np.testing.assert_allclose(found.record.pv[:, 0], data.pv)


def test_two_zones_in_one_file_are_ambiguous(tmp_path: Path) -> None:
    data = clean(3000)
    shifted = data.time_s - np.where(np.arange(3000) < 1500, 0.0, 7200.0)
    found = screen_of(data.with_(time_s=shifted), tmp_path)
    accounted(found)
    assert found.report.tags[0].readings["clock"] == 2 * 1200
    again = screen(write(tmp_path / "x.csv", [*cells(data)[:2000], *cells(data)[1400:]]))  # sent again, and no fault
    assert again.report.tags[0].readings == {"good": 3000, "duplicate": 600}
    assert len(again.record) == 3000


@pytest.mark.parametrize(("late", "first"), [(0, 4), (2, 2), (-3, 7)])
def test_the_first_answer_is_told(late: int, first: int, tmp_path: Path) -> None:
    """u(k-2) acts on y(k+1), and the move at row k is u(k): the answer is at row k + 3; the noise hides none of it."""
    data = clean(2500)
    (valve, _) = screen_of(data.with_(mv=np.roll(data.mv, late)), tmp_path).report.verdict.inputs
    assert valve.first_answer_s["TIC-101.PV"] == pytest.approx((first - 1) * PERIOD_S)
    assert valve.gain["TIC-101.PV"] == pytest.approx(0.8, rel=0.1)
    assert valve.band_share > 0.5
    assert valve.coherence["TIC-101.PV"] > 0.7


def test_a_late_mv_is_doubted(tmp_path: Path) -> None:
    data = clean(2500)
    verdict = screen_of(data.with_(mv=np.roll(data.mv, 8)), tmp_path).report.verdict
    assert verdict.carries == "doubtful"
    assert "its column is late" in " ".join(verdict.reasons)


def test_swapped_tags_are_told(tmp_path: Path) -> None:
    tags = (Tag("TIC-101.OP", "pv", "%"), Tag("TIC-101.PV", "mv", "degC"), TAGS[2])
    verdict = screen_of(clean(2500), tmp_path, tags).report.verdict
    assert verdict.carries == "no"
    assert "are the two swapped" in " ".join(verdict.reasons)
