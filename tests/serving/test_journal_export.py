"""A journal as training data: in the plant's time, run after run."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd

from serving import Controller
from serving.journal import Journal, Scan, columns
from serving.station.export import export, tag_table

pytest_plugins = ["small_laws"]


def test_times_are_the_plants_and_runs_follow_each_other(tmp_path: Path, controller: Controller) -> None:
    m, width = controller.manifest, len(columns(controller.manifest))
    journal = Journal(tmp_path / "loop.journal")
    for began, speed in ((1e9, 100.0), (1e9 + 10, 100.0), (1.1e9, 1.0)):
        journal.begin(m, controller.sha256, began, speed)
        for k in range(40):
            when = began + k * m.period_s / speed
            journal.scan(Scan(when, "AUTO", tuple(map(float, range(width))), reason=""))
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
