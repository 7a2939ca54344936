"""The old PI of a record: its numbers come back from closed loops, and hand operation is not taken for one."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from loopwright.pipeline.historian.cleaning.row_grid import Grid
from loopwright.pipeline.historian.cleaning.tags import Tag
from loopwright.pipeline.historian.old_loop_fit import old_controllers
from loopwright.pipeline.records.old_loops import OldController

H = 10.0  # s
TAGS = (
    Tag("TIC-1.PV", "pv", "degC", name="T"),
    Tag("TIC-1.OP", "mv", "%", 0.0, 100.0, name="valve"),
    Tag("TIC-1.SP", "sp", "degC"),
)
Columns = dict[str, NDArray[np.float64]]


def closed(
    n: int = 6000,
    kc: float = 1.0,
    ti_s: float = 200.0,
    td_s: float = 0.0,
    b: float = 1.0,
    gain: float = 1.0,
    manual: float = 0.0,
    late: int = 0,
    digits: int = 1,
    seed: int = 1,
    moves: int | None = None,
) -> Columns:
    """A lag of 200 s with 30 s dead time and a wandering load, under a PID whose MV the export rounds."""
    random = np.random.default_rng(seed)
    noise, drift = random.normal(0, 0.1, n), random.normal(0, 0.3, n)
    pv, mv, sp = np.empty(n), np.empty(n), np.empty(n)
    u, x, load, r, hand = 50.0, 0.0, 0.0, 0.0, 0
    p1 = y1 = y2 = noise[0]
    pipe = [u] * 4
    for k in range(n):
        y = x + noise[k]
        if random.random() < 1 / 150 and moves is None:
            r = random.normal(0, 4)
        if moves and k and k % (n // (moves + 1)) == 0:
            r = 4.0 if r <= 0 else -4.0
        if not hand and random.random() < manual / 60:
            hand = 60
        if hand:
            hand -= 1
            u += 5 * random.choice([-1, 1]) * (random.random() < 1 / 20)
        else:
            u += kc * (b * r - y - p1 + H / ti_s * (r - y) - td_s / H * (y - 2 * y1 + y2))
        u = float(np.clip(u, 0, 100))
        p1, y2, y1 = b * r - y, y1, y
        pv[k], mv[k], sp[k] = y, u, r
        load += -load / 200 + drift[k]
        pipe.append(u - 50 + load)
        x += (gain * pipe.pop(0) - x) * (1 - np.exp(-H / 200)) if k >= 4 else 0.0
    pv = np.append(pv[late:], np.full(late, pv[-1]))
    return {"TIC-1.PV": np.round(pv, 2), "TIC-1.OP": np.round(mv, digits), "TIC-1.SP": sp}


def by_hand(tau_s: float, same_row: bool, hold: int, seed: int) -> Columns:
    """Steps of an operator, a load, and the answer of a lag; the set point rests."""
    random, n = np.random.default_rng(seed), 6000
    u = np.repeat(np.round(random.uniform(20, 80, n), 1), hold)[:n]
    a = np.exp(-H / tau_s) if tau_s else 0.0
    pv, x = np.empty(n), 0.0
    for k in range(n):
        before, x = x, a * x + (1 - a) * (u[k] - 50)
        pv[k] = x if same_row else before
    return {"TIC-1.PV": np.round(pv + random.normal(0, 0.1, n), 2), "TIC-1.OP": u, "TIC-1.SP": np.full(n, 5.0)}


def found(columns: Columns, tags: tuple[Tag, ...] = TAGS) -> tuple[OldController, ...]:
    n = len(columns["TIC-1.PV"])
    grid = Grid(H, H * np.arange(n), np.zeros(n, dtype=np.int64), columns, {}, {})
    return old_controllers(grid, np.zeros(n, dtype=np.uint8), tags, {})


@pytest.mark.parametrize(
    "settings",
    [
        {"kc": 1.0, "ti_s": 200.0},
        {"kc": 0.2, "ti_s": 300.0},
        {"kc": -1.0, "ti_s": 200.0, "gain": -1.0},
        {"kc": 1.0, "ti_s": 200.0, "td_s": 50.0},
        {"kc": 1.0, "ti_s": 200.0, "b": 0.0},
        {"kc": 1.0, "ti_s": 200.0, "b": 0.5},
        {"kc": 1.0, "ti_s": 3000.0},
        {"kc": 1.0, "ti_s": 200.0, "late": 1},
        {"kc": 1.0, "ti_s": 200.0, "n": 600},
        {"kc": 1.0, "ti_s": 200.0, "manual": 0.2},  # a fifth of the time by hand, and no mode says when
    ],
    ids=str,
)
def test_the_numbers_of_the_old_law_come_back_from_a_closed_loop(settings: dict[str, float]) -> None:
    (law,) = found(closed(**settings))  # type: ignore[arg-type]
    assert law.believed, law.doubt
    assert law.share > 0.98
    assert law.kc == pytest.approx(settings["kc"], rel=0.04)
    assert law.ti_s == pytest.approx(settings["ti_s"], rel=0.06)
    assert law.td_s == pytest.approx(settings.get("td_s", 0.0), abs=3.0)
    assert law.set_point_weight == pytest.approx(settings.get("b", 1.0), abs=0.02)
    assert law.late_rows == settings.get("late", 0)


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize(
    ("tau_s", "same_row", "hold"), [(200, False, 40), (20, False, 5), (0, True, 30), (30, True, 2)]
)
def test_hand_operation_is_not_taken_for_a_controller(tau_s: float, same_row: bool, hold: int, seed: int) -> None:
    (law,) = found(by_hand(tau_s, same_row, hold, seed))
    assert not law.believed
    assert law.doubt in law.words


@pytest.mark.parametrize("b", [1.0, 0.0, 0.5])
@pytest.mark.parametrize("moves", [4, 8])
def test_few_moves_of_the_set_point_tell_how_the_law_answers_to_them(moves: int, b: float) -> None:
    """Half of all movement lies in windows without one: there P on the error and P on the PV do the same."""
    (law,) = found(closed(b=b, moves=moves))
    assert law.believed, law.doubt
    assert law.set_point_weight == pytest.approx(b, abs=0.05)
    assert law.kc == pytest.approx(1.0, rel=0.05)


def test_a_proportional_controller_is_not_taken_for_a_pi() -> None:
    (law,) = found(closed(ti_s=1e12))
    assert not law.believed


def test_rows_that_are_too_few_are_said() -> None:
    (law,) = found(closed(n=150))
    assert (law.believed, law.rows) == (False, 0)
    assert "150 rows" in law.words


def test_the_mv_of_the_same_name_is_the_loops_and_without_names_the_one_that_is_explained_best() -> None:
    other = closed(seed=2, kc=0.5)
    columns = closed() | {"TIC-2.OP": other["TIC-1.OP"], "X": other["TIC-1.OP"], "Y": closed()["TIC-1.OP"]}
    named = (*TAGS, Tag("TIC-2.OP", "mv", "%", name="other"))
    (law,) = found(columns, named)
    assert law.mv == "valve"
    nameless = (*(replace(t, tag="X" if t.role == "mv" else t.tag) for t in TAGS), Tag("Y", "mv", "%", name="its own"))
    (law,) = found(columns, nameless)
    assert (law.mv, law.believed) == ("its own", True)


def test_without_a_set_point_there_is_none() -> None:
    assert found(closed(n=600), TAGS[:2]) == ()
