"""The last lines of a simulated run: an MV that rests at its end while an error stays is named."""

from __future__ import annotations

import numpy as np
import pytest
from identified_models import made_signals

from loopwright.pipeline.pictures.loop_picture import History, summary


class Plant:
    """A plant of which only the signals matter."""

    signals = made_signals(1, 2)
    sp_signals, pv_signals, mv_signals = signals.sp, signals.pv, signals.mv


def said(error: float, mv: list[float]) -> str:
    n = 50
    history = History(
        [float(k) for k in range(n)],
        ["AUTO"] * n,
        [np.array([1.0])] * n,
        [np.array([1.0 + error])] * n,
        [np.array([1.0])] * n,
        [np.array(mv)] * n,
        [""] * n,
    )
    return summary(Plant(), history)  # type: ignore[arg-type]


def test_an_error_that_stays_names_the_mvs_at_their_ends() -> None:
    text = said(0.5, [1.0, 0.3])
    assert "an error stays with u0 at 1 V, an end of its range: these set points may be out of reach" in text
    assert "u1 at" not in text
    assert "u0 at -1 V and u1 at 1 V" in said(0.5, [-1.0, 1.0])


@pytest.mark.parametrize(("error", "mv"), [(0.0, [1.0, 0.0]), (0.5, [0.9, 0.0])])
def test_nothing_is_said_where_the_error_goes_or_the_mvs_have_room(error: float, mv: list[float]) -> None:
    assert "out of reach" not in said(error, mv)
