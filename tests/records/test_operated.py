"""How a plant was run while its record was made: one definition, over the rows in automatic where a mode is known."""

from __future__ import annotations

import numpy as np
import pytest

from loopwright.pipeline.historian.cleaning.row_grid import Grid
from loopwright.pipeline.historian.cleaning.tags import Tag
from loopwright.pipeline.historian.old_loop_fit import old_controllers, operated
from loopwright.pipeline.records.old_loops import operation

SP = np.array([10.0, 10.0, 10.0, 12.0, 12.0, 12.0])
PV = np.array([10.0, 11.0, 10.0, 10.0, 11.0, 12.0])
MV = np.array([[50.0], [51.0], [49.0], [60.0], [60.0], [61.0]])
TAGS = (
    Tag("TIC-1/PV", "pv", "degC", name="T"),
    Tag("TIC-1/OP", "mv", "%", name="valve"),
    Tag("TIC-1/SP", "sp", "degC"),
    Tag("TIC-1/MODE", "mode"),
)


def grid(mode: list[float]) -> Grid:
    values = {"TIC-1/PV": PV, "TIC-1/OP": MV[:, 0], "TIC-1/SP": SP, "TIC-1/MODE": np.array(mode)}
    return Grid(30.0, 30.0 * np.arange(6), np.zeros(6, dtype=np.int64), values, {}, {})


def test_errors_count_by_their_size_and_moves_by_the_minute_within_a_piece() -> None:
    error, travel = operation(SP, PV, MV, np.array([0, 0, 0, 1, 1, 1]), 30.0)
    assert error == pytest.approx((0 + 1 + 0 + 2 + 1 + 0) / 6)
    assert travel == pytest.approx([(1 + 2 + 0 + 1) / (4 * 0.5)])  # the move of 11 lies between two pieces


@pytest.mark.parametrize(
    ("names", "mode", "rows", "automatic", "mae", "travel"),
    [
        (("AUT", "MAN"), [0, 0, 0, 1, 0, 0], 5, True, 2 / 5, (1 + 2 + 1) / (3 * 0.5)),
        (("1", "2"), [0, 0, 0, 1, 0, 0], 6, False, 4 / 6, 15 / 2.5),  # nobody knows which is automatic
        (("Cascade",), [0] * 6, 6, True, 4 / 6, 15 / 2.5),
    ],
)
def test_rows_in_automatic_count_where_a_mode_says_which_they_are(
    names: tuple[str, ...], mode: list[float], rows: int, automatic: bool, mae: float, travel: float
) -> None:
    (found,) = operated(grid(mode), np.zeros(6, dtype=np.uint8), TAGS, {"TIC-1/MODE": names})
    assert (found.pv, found.rows, found.automatic) == ("T", rows, automatic)
    assert found.mae == pytest.approx(mae)
    assert found.travel == pytest.approx({"valve": travel})


@pytest.mark.parametrize("names", [("MAN",), ("M", "AUTO"), ("Manual", "LOCKED")])
def test_a_loop_that_was_in_manual_all_the_time_followed_no_set_point(names: tuple[str, ...]) -> None:
    modes, rows = {"TIC-1/MODE": names}, np.zeros(6, dtype=np.uint8)
    assert operated(grid([0] * 6), rows, TAGS, modes) == ()
    (law,) = old_controllers(grid([0] * 6), rows, TAGS, modes)
    assert (law.believed, law.same_name, law.rows) == (False, True, 0)  # the tags belong together all the same


def test_without_a_set_point_there_is_no_figure() -> None:
    assert operated(grid([0] * 6), np.zeros(6, dtype=np.uint8), TAGS[:2], {}) == ()
