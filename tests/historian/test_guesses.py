"""Roles that are guessed from names and readings: what a controller shall hold, and what is no signal at all."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest

from loopwright.pipeline.historian.arx_model import fit_arx, lead
from loopwright.pipeline.historian.files.file_reader import read_export, units_of
from loopwright.pipeline.historian.guessing import guesses

N = 3000


def tank() -> dict[str, np.ndarray]:
    """A tank: its level answers to a valve in its outflow and to the inflow; the outflow follows the valve."""
    random = np.random.default_rng(0)
    valve = np.repeat(random.uniform(30, 70, N // 50), 50)
    inflow = 50 + np.repeat(random.uniform(-8, 8, N // 60), 60)
    level = np.full(N, 5.0)
    for k in range(N - 1):
        level[k + 1] = max(level[k] + 0.002 * (inflow[k] - valve[k] * np.sqrt(level[k] / 5)), 0.2)
    return {
        "out": valve * np.sqrt(level / 5) + random.normal(0, 0.2, N),
        "level": level + random.normal(0, 0.01, N),
        "valve": valve,
        "in": inflow,
        "batch": 4711 + np.arange(N) // 333.0,
        "switch": np.arange(N) // 500 % 2.0,
        "grade": np.repeat(random.integers(1, 5, N // 250), 250).astype(float),
        "whole": np.round(valve),
        "sp": np.repeat(random.uniform(4, 6, N // 100), 100).round(1),
        "mode": np.where(np.arange(N) % 900 < 800, "AUTO", "MAN"),
        "position": np.where(np.arange(N) % 700 < 600, "Open", "Closed"),
        "two": np.where(valve > 50, 55.0, 45.0),
    }


def roles(path: Path, columns: dict[str, str]) -> dict[str, str]:
    """Guessed roles of an export of some columns of the tank, by their heads."""
    data = tank()
    columns_of = [10 * np.arange(N), *(data[key] for key in columns.values())]
    texts = [[v if isinstance(v, str) else f"{v:.6g}" for v in column.tolist()] for column in columns_of]
    lines = [",".join(["time_s", *columns]), *map(",".join, zip(*texts, strict=True))]
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return {g.tag.tag: g.tag.role for g in guesses(read_export([path]), units_of([path]))}


NAMED = ("Outflow [m3/h]", "Level [m]", "Valve position [%]", "Inflow [m3/h]")
BARE = ("FI-2 [m3/h]", "LI-1 [m]", "HV-1 [%]", "FI-3 [m3/h]")
INDICATED = ("FI-2.PV [m3/h]", "LI-1.PV [m]", "LIC-1.OP [%]", "FI-3.PV [m3/h]")


@pytest.mark.parametrize("heads", [NAMED, BARE, INDICATED])
def test_an_outflow_is_not_what_a_controller_holds(heads: Sequence[str], tmp_path: Path) -> None:
    found = roles(tmp_path / "export.csv", dict(zip(heads, ("out", "level", "valve", "in"), strict=True)))
    assert list(found.values()) == ["", "pv", "mv", "dv"]


def test_a_flow_with_a_loop_of_its_own_is(tmp_path: Path) -> None:
    heads = {"FIC-2.PV [m3/h]": "out", "FIC-2.OP [%]": "valve", "LI-1.PV [m]": "level"}
    assert roles(tmp_path / "export.csv", heads)["FIC-2.PV"] == "pv"


@pytest.mark.parametrize("flow", ["Débit sortie", "Ablauf", "Durchsatz", "Product [gpm]", "Gas [kNm³/h]", "F-2"])
def test_a_flow_is_told_in_many_ways(flow: str, tmp_path: Path) -> None:
    found = roles(tmp_path / "export.csv", {flow: "out", "Quality": "level", "Vanne": "valve"})
    assert list(found.values()) == ["", "pv", "mv"]


@pytest.mark.parametrize("head", ["F101 Temp", "F1-T [degC]", "Flow box level", "FI-7 [bar]", "TI-F12.PV", "33TI07.PV"])
def test_another_quantity_is_no_flow(head: str, tmp_path: Path) -> None:
    found = roles(tmp_path / "export.csv", {head: "level", "LC": "out", "valve": "valve"})
    assert found[head.partition(" [")[0]] == "pv"


@pytest.mark.parametrize("head", ["ID-fan", "Fan No 1 speed", "Speed no 1"])
def test_a_number_within_a_name_makes_no_label(head: str, tmp_path: Path) -> None:
    found = roles(tmp_path / "export.csv", {"Temp": "level", head: "whole"})
    assert found == {"Temp": "pv", head: "mv"}


def test_the_current_value_of_a_parameter_is_its_role(tmp_path: Path) -> None:
    heads = {"T1/PID1/PV.CV": "level", "T1/PID1/SP.CV": "sp", "T1/PID1/OUT.CV": "valve", "T1/PID1/MODE.ACTUAL": "mode"}
    assert list(roles(tmp_path / "export.csv", heads).values()) == ["pv", "sp", "mv", "mode"]


LABELS = {"Batch": "batch", "Product grade": "grade", "Mixer on": "switch"}
LABELS |= dict.fromkeys(
    ["Produktnummer", "Rezept", "Sorte", "Schicht", "Recette", "Lote", "Batch ID", "Lot nr."], "grade"
)


@pytest.mark.parametrize("head", LABELS)
def test_a_label_is_no_mv(head: str, tmp_path: Path) -> None:
    label = LABELS[head]
    found = roles(tmp_path / "export.csv", {head: label, "LI-1 [m]": "level", "HV-1 [%]": "valve"})
    assert found == {head: "", "LI-1": "pv", "HV-1": "mv"}


@pytest.mark.parametrize("stopped", [slice(1400, 1520), slice(0, 60), slice(2950, 3000)])
def test_a_stop_at_zero_is_no_other_unit(stopped: slice, tmp_path: Path) -> None:
    """0 is 1000 times 0: the rows before a stop were once taken for a slip, and left out of the guessed range."""
    random = np.random.default_rng(3)
    valve = np.clip(np.cumsum(random.normal(0, 1.0, N)) + np.linspace(30, 75, N), 1, 99).round(2)
    valve[stopped] = 0.0
    lines = ["time_s,TIC-1.PV,TIC-1.OP", *(f"{10 * k},{50 + random.normal():.3f},{v:g}" for k, v in enumerate(valve))]
    (path := tmp_path / "export.csv").write_text("\n".join(lines) + "\n", encoding="utf-8")
    found = {g.tag.tag: g.tag for g in guesses(read_export([path]), units_of([path]))}["TIC-1.OP"]
    assert (found.low, found.high) == (0.0, valve.max())


def test_an_mv_of_two_values_is_one(tmp_path: Path) -> None:
    assert roles(tmp_path / "export.csv", {"LI-1 [m]": "level", "HV-1 [%]": "two"})["HV-1"] == "mv"


@pytest.mark.parametrize("seed", [5, 8, 20, 37, 43])
def test_a_column_that_copies_an_mv_is_fitted(seed: int) -> None:
    """The fit is exact but for its ridge: once no row was left of it, and `new` ended without a table."""
    u = np.repeat(np.round(np.clip(np.random.default_rng(seed).normal(50, 15, 70), 5, 95), 1), 60)[:4000]
    model = fit_arx(u, [u], np.zeros(len(u), dtype=np.int64))
    assert model is not None
    assert lead(model, u, [u], 0)[0] > 1e3


@pytest.mark.parametrize(
    ("parts", "expected"),
    [
        (("PV", "OP", "SP", "MODE"), ["pv", "mv", "sp", "mode"]),
        (("PV", "CV", "SP", "MODE"), ["pv", "mv", "sp", "mode"]),  # the output is the control variable
        (("CV", "OUT", "SP", "MD"), ["pv", "mv", "sp", "mode"]),
        (("PV", "MV", "SV", "MODE"), ["pv", "mv", "sp", "mode"]),
        (("PV", "LMN", "SP", "MODE"), ["pv", "mv", "sp", "mode"]),
        (("Istwert", "Stellgröße", "Soll", "Betriebsart"), ["pv", "mv", "sp", "mode"]),
        (("PV.CV", "OUT.CV", "SP.CV", "MODE.ACTUAL"), ["pv", "mv", "sp", "mode"]),
        (("PV", "OP", "SP", "BA"), ["pv", "mv", "sp", "mode"]),  # its texts are modes
        (("PV.CV", "OUT.CV", "SV.CV", "BA"), ["pv", "mv", "sp", "mode"]),
        (("MW", "Y", "SW", "BA"), ["pv", "mv", "sp", "mode"]),
    ],
)
def test_parts_of_a_loop_by_the_names_that_systems_give_them(
    parts: Sequence[str], expected: list[str], tmp_path: Path
) -> None:
    heads = [f"LIC-1.{part}" for part in parts]
    found = roles(tmp_path / "export.csv", dict(zip(heads, ("level", "valve", "sp", "mode"), strict=True)))
    assert list(found.values()) == expected


@pytest.mark.parametrize(
    ("heads", "expected"),
    [
        (("LIC-1.PV", "SV-101.OP"), ["pv", "mv"]),  # a solenoid valve
        (("LIC-1.PV", "LV-1.OP", "LIC-1.SP", "XV-7.STATUS"), ["pv", "mv", "sp", ""]),
    ],
)
def test_words_that_mean_something_else_elsewhere(heads: Sequence[str], expected: list[str], tmp_path: Path) -> None:
    found = roles(tmp_path / "export.csv", dict(zip(heads, ("level", "valve", "sp", "position"), strict=False)))
    assert list(found.values()) == expected


def test_a_switch_is_no_set_point_though_its_tag_ends_as_one(tmp_path: Path) -> None:
    columns = {"LIC-1.MW": "level", "LIC-1.Y": "valve", "LIC-1.SW": "sp", "HS-7.SW": "switch"}
    assert list(roles(tmp_path / "export.csv", columns).values())[:3] == ["pv", "mv", "sp"]
    assert roles(tmp_path / "export.csv", columns)["HS-7.SW"] != "sp"


def test_a_set_point_that_was_moved_once_or_never_is_one(tmp_path: Path) -> None:
    columns = {"LIC-1.MW": "level", "LIC-1.Y": "valve", "LIC-1.SW": "two"}
    assert roles(tmp_path / "two.csv", columns)["LIC-1.SW"] == "sp"
    columns = {"LIC-1.MW.CV": "level", "LIC-1.OUT.CV": "valve", "LIC-1.SW.CV": "sp"}
    assert list(roles(tmp_path / "attributes.csv", columns).values()) == ["pv", "mv", "sp"]


def test_a_cv_beside_an_output_is_no_output(tmp_path: Path) -> None:
    heads = ("LIC-1.PV", "LIC-1.CV", "LV-1.OP", "LIC-1.SP")
    found = roles(tmp_path / "export.csv", dict(zip(heads, ("level", "level", "valve", "sp"), strict=True)))
    assert found["LV-1.OP"] == "mv"
    assert found["LIC-1.CV"] != "mv"


def test_a_variable_without_a_loop_is_not_controlled_where_others_have_one(tmp_path: Path) -> None:
    heads = {"LIC-1.PV": "level", "LIC-1.OP": "valve", "LIC-1.SP": "sp", "PDT7.PV": "whole", "33FT07.PV": "in"}
    assert list(roles(tmp_path / "one.csv", heads).values()) == ["pv", "mv", "sp", "", "dv"]
    # As many MVs as PVs: each may be held, whatever its tag is called.
    heads = {"LIC-1.PV": "level", "LIC-1.OP": "valve", "LIC-1.SP": "sp", "PT7.PV": "out", "V2.OP": "in"}
    assert roles(tmp_path / "two.csv", heads)["PT7.PV"] == "pv"


def test_the_mode_of_a_module_belongs_to_the_loop_within_it(tmp_path: Path) -> None:
    data = {"FIC1/PID1/PV.CV": "level", "FIC1/PID1/OUT.CV": "valve", "FIC1/PID1/SP.CV": "sp", "FIC1/MODE.CV": "mode"}
    roles(tmp_path / "block.csv", data)
    found = guesses(read_export([tmp_path / "block.csv"]), {})
    assert {g.tag.role: g.tag.loop for g in found} == dict.fromkeys(("pv", "mv", "sp", "mode"), "FIC1/PID1")
