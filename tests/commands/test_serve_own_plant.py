"""``loopwright plant serve`` of an own plant: its identified model, and said to be one."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from own_cases import controllers_of_a_lag

from loopwright.pipeline.__main__ import main
from loopwright.pipeline.cases import CASES
from loopwright.pipeline.commands.plant import start_of
from loopwright.pipeline.errors import PlantError
from loopwright.pipeline.simulation import opcua_server


def test_its_model_is_served_where_it_rests(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    case = controllers_of_a_lag({})
    x, mv = start_of(case)
    assert case.plant.step(x, mv, case.plant.dv_nominal, case.plant.parameters({})) == pytest.approx(x, abs=1e-6)
    capsys.readouterr()
    served: list[opcua_server.PlantServer] = []

    async def run(self: opcua_server.PlantServer, periods: int | None) -> None:
        served.append(self)

    monkeypatch.setattr(opcua_server.PlantServer, "run", run)
    assert main(["plant", "serve", case.name]) in {0, None}
    assert np.array_equal(served[0].mv, mv)
    assert "is the model that was identified from the record" in capsys.readouterr().err


def test_without_a_model_a_line_says_what_to_do(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    case = controllers_of_a_lag({})
    for path in Path("work").rglob("*.npz"):
        path.unlink()
    with pytest.raises(PlantError, match=f"`loopwright run {case.name}` trains"):
        start_of(type(case)(case.held_out_seeds))


def test_a_built_in_case_begins_as_its_first_test_does() -> None:
    case = CASES["batch_reactor"]
    x, mv = start_of(case)
    assert (x.shape, mv.tolist()) == ((3,), [0.0])
