"""``plants:`` in params.yaml: appended whole or not at all, and every byte before it stays."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st

from pipeline.config.params import read_section, sections
from pipeline.config.plants import PlantParams, append_plant, check_name, own_plants
from pipeline.errors import ParamsError

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


@pytest.mark.parametrize("end", ["\n", "\r\n"])
@pytest.mark.parametrize("tail", ["", "\n\n", "# the end"])
def test_every_byte_stays(end: str, tail: str, tmp_path: Path) -> None:
    before = (ROOT / "params.yaml").read_bytes() + tail.encode()
    before = before.replace(b"\n", end.encode())
    path = tmp_path / "params.yaml"
    path.write_bytes(before)
    append_plant("tank", ENTRY, path)
    append_plant("second", {**ENTRY, "period_s": 2}, path)
    after = path.read_bytes()
    assert after.startswith(before)
    assert after.replace(b"\r\n", b"").count(b"\n") == (0 if end == "\r\n" else after.count(b"\n"))
    assert list(own_plants(path)) == ["tank", "second"]
    tank = PlantParams.read("tank", path)
    assert (tank.pv[0].name, tank.pv[0].high, tank.source[0].file) == ("TIC-101.PV", 1e-5, "Öl: #1.csv")
    assert sections("cases", path) == sections("cases", ROOT / "params.yaml")
    assert read_section("plants", "second", path)["period_s"] == 2


def test_a_section_in_the_middle_grows_in_place(tmp_path: Path) -> None:
    path = tmp_path / "params.yaml"
    path.write_text("cases: {}\nplants:\n  # mine\n  one: {}\n\n# of the next\nrecords:\n  a: 1")
    append_plant("two", ENTRY, path)
    text = path.read_text()
    assert text.startswith("cases: {}\nplants:\n  # mine\n  one: {}\n  two:\n")
    assert text.endswith("\n\n# of the next\nrecords:\n  a: 1")
    assert list(yaml.safe_load(text)["plants"]) == ["one", "two"]


@pytest.mark.parametrize(
    ("text", "name", "says"),
    [
        ("plants:\n  tank: {}\n", "tank", "plants has 'tank' already"),
        ("cases:\n  tank: {}\n", "tank", "cases has 'tank' already"),
        ("plants: {a: {}}\n", "tank", "is not a block"),
        ("a: [1\n", "tank", "is not YAML"),
        ("a: 1\n", "Tank", "cannot be a plant's"),
        ("a: 1\n", "../x", "cannot be a plant's"),
        ("a: 1\n...\n", "tank", "cannot be added|is not YAML"),
    ],
)
def test_a_refusal_changes_nothing(text: str, name: str, says: str, tmp_path: Path) -> None:
    path = tmp_path / "params.yaml"
    path.write_text(text)
    with pytest.raises(ParamsError, match=says):
        append_plant(name, ENTRY, path)
    assert path.read_text() == text
    assert [p.name for p in tmp_path.iterdir()] == ["params.yaml"]


@settings(max_examples=40, deadline=None)
@given(st.text(st.characters(exclude_categories=["Cs", "Cc"]), min_size=1, max_size=12), st.floats(-1e9, 1e9))
def test_any_signal_survives(name: str, low: float) -> None:
    import tempfile

    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "params.yaml"
        path.write_text("cases: {}\n")
        signal = {"name": name, "unit": name, "low": low, "high": low + abs(low) + 1.0}
        append_plant("x", {**ENTRY, "pv": [signal], "mv": [{**signal, "name": name + "_"}]}, path)
        assert PlantParams.read("x", path).pv[0].name == name
        assert PlantParams.read("x", path).pv[0].low == low


def test_names(tmp_path: Path) -> None:
    path = tmp_path / "params.yaml"
    path.write_text("cases: {}\n")
    check_name("tank_2", path)
    with pytest.raises(ParamsError, match="plants has no 'x'"):
        PlantParams.read("x", path)
    with pytest.raises(ParamsError, match=r"signal 'OP' is there twice"):
        append_plant("x", {**ENTRY, "pv": ENTRY["mv"]}, path)
