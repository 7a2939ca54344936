"""``plants:`` in params.yaml: names and signals."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from loopwright.pipeline.config.params import add_entries
from loopwright.pipeline.config.plants import PlantParams, check_name
from loopwright.pipeline.errors import ParamsError

ROOT = Path(__file__).parents[2]
T = {"name": "TIC-101.PV", "unit": "degC", "low": 0.0, "high": 1e-5}
ENTRY: dict[str, Any] = {
    "period_s": 10.0,
    "pv": [T],
    "mv": [{"name": "OP", "unit": "%", "low": 0.0, "high": 100.0}],
    "dv": [],
    "data": "data/tank/record.parquet",
    "source": [{"file": "Öl: #1.csv", "sha256": "0" * 64}],
}


@settings(max_examples=40, deadline=None)
@given(st.text(st.characters(exclude_categories=["Cs", "Cc"]), min_size=1, max_size=12), st.floats(-1e9, 1e9))
def test_any_signal_survives(name: str, low: float) -> None:
    import tempfile

    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "params.yaml"
        path.write_text("cases: {}\n")
        signal = {"name": name, "unit": name, "low": low, "high": low + abs(low) + 1.0}
        add_entries({"plants": {"x": {**ENTRY, "pv": [signal], "mv": [{**signal, "name": name + "_"}]}}}, path)
        assert PlantParams.read("x", path).pv[0].name == name
        assert PlantParams.read("x", path).pv[0].low == low


def test_names(tmp_path: Path) -> None:
    path = tmp_path / "params.yaml"
    path.write_text("cases: {}\n")
    check_name("tank_2", path)
    with pytest.raises(ParamsError, match="plants has no 'x'"):
        PlantParams.read("x", path)
    for name in ("Tank", "../x", "2nd", ""):
        with pytest.raises(ParamsError, match="cannot be a plant's"):
            check_name(name, path)
    add_entries({"plants": {"x": {**ENTRY, "pv": ENTRY["mv"]}}, "cases": {"y": {}}}, path)
    for name, kind in {"x": "plants", "y": "cases"}.items():
        with pytest.raises(ParamsError, match=f"{kind} has '{name}' already"):
            check_name(name, path)
    with pytest.raises(ParamsError, match=r"signal 'OP' is there twice"):
        PlantParams.read("x", path)
