"""The page of a plant that no shipped case has: two MVs, two set points, a measured disturbance that the law uses."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, ClassVar, Self

import casadi as ca
import numpy as np
import pytest
import torch
from chromium import CHROMIUM, launched
from torch import Tensor

from loopwright.pipeline.evaluation.case import Case
from loopwright.pipeline.export.gate import export
from loopwright.pipeline.export.plant_graphs import plant_graphs
from loopwright.pipeline.laws import ControlLaw
from loopwright.pipeline.plants.equations import EquationPlant
from loopwright.pipeline.plants.simulator import Array
from loopwright.pipeline.playground.about import about
from loopwright.pipeline.playground.site import Playground, write_one_file
from loopwright.pipeline.playground.web_runtime import kept
from loopwright.pipeline.simulation.scenario import Scenario
from loopwright.serving import Controller, ControlLoop, Mode, Sample, Signal

if CHROMIUM is None:
    pytest.skip("no chromium is installed (Debian: apt install chromium-headless-shell)", allow_module_level=True)
if not kept().exists():
    pytest.skip(
        "onnxruntime-web is not here (python -m loopwright.pipeline.playground.web_runtime)", allow_module_level=True
    )

from playwright.sync_api import expect

CHANGE, END = 30, 80


@dataclass(frozen=True)
class Basin(EquationPlant):
    """dh/dt = k (hot + cold + d - 0.4 h), dT/dt = 0.05 (60 hot + 10 cold + 20 d - T (hot + cold + d)) in l/s."""

    k: float = field(default=0.05, metadata={"unit": "m/l"})
    name: ClassVar[str] = "basin"
    title: ClassVar[str] = "Basin of hot & cold water"
    state_signals: ClassVar[tuple[Signal, ...]] = (Signal("h", "m", 0.0, 10.0), Signal("T", "degC", 0.0, 100.0))
    pv_signals: ClassVar[tuple[Signal, ...]] = state_signals
    sp_signals: ClassVar[tuple[Signal, ...]] = (Signal("h", "m", 1.0, 8.0), Signal("T", "degC", 15.0, 50.0))
    mv_signals: ClassVar[tuple[Signal, ...]] = (Signal("hot", "l/s", 0.0, 2.0), Signal("cold", "l/s", 0.0, 2.0))
    dv_signals: ClassVar[tuple[Signal, ...]] = (Signal("rain", "l/s", 0.0, 1.0),)
    period_s: ClassVar[float] = 2.0
    substeps: ClassVar[int] = 2

    @property
    def start(self) -> tuple[Array, Array]:
        return np.array([4.0, 30.0]), np.array([0.6, 0.7])

    @property
    def dv_nominal(self) -> Array:
        return np.array([0.3])

    def derivative(self, x: Any, mv: Any, dv: Any) -> Any:
        flow = mv[0] + mv[1] + dv[0]
        warm = 60 * mv[0] + 10 * mv[1] + 20 * dv[0]
        return ca.vertcat(self.k * (flow - 0.4 * x[0]), 0.05 * (warm - x[1] * flow))


@dataclass(frozen=True)
class BasinCase(Case):
    """A case with one test, in which the disturbance moves."""

    held_out_seeds: tuple[int, ...] = (1,)
    name: ClassVar[str] = "basin"
    title: ClassVar[str] = "Basin of hot & cold water"
    plant_class: ClassVar[type[EquationPlant]] = Basin
    development_seeds: ClassVar[tuple[int, ...]] = (2,)
    noise: ClassVar[Mapping[str, float]] = {"h": 0.01, "T": 0.1}
    gate: ClassVar[Mapping[str, float]] = {"rain": 1.0}
    baseline: ClassVar[str] = "feedforward"

    def scenarios(self) -> dict[str, tuple[Scenario, ...]]:
        x, mv = self.plant.start
        dv = np.where(np.arange(END) < 60, 0.3, 0.7)[:, None]
        return {"rain": (Scenario("rain", "A shower", np.tile([4.0, 30.0], (END, 1)), x, mv, dv=dv),)}

    def development(self) -> tuple[Scenario, ...]:
        return ()


class Feedforward(ControlLaw):
    """Two integral loops, and less of both waters when it rains; it remembers the rain."""

    name = "feedforward"
    title = "Feedforward"
    Params = type(None)
    n_state = 2
    info = ("rain_change",)

    @classmethod
    def design(cls, params: Any, models: Mapping[str, Any], signals: Any, plant: Any) -> Self:
        raise NotImplementedError

    def forward(self, sp: Tensor, pv: Tensor, dv: Tensor, mv_applied: Tensor, state: Tensor) -> Any:
        error = sp - pv
        change = torch.where(state[..., :1] > 0, dv - state[..., 1:], torch.zeros_like(dv))
        level, warmth = error[..., :1] * 0.05, error[..., 1:] * 0.005
        move = torch.cat([level + warmth, level - warmth], dim=-1) - 0.5 * change
        return self.limited(mv_applied + move, mv_applied), torch.cat([torch.ones_like(dv), dv], dim=-1), change


def test_two_loops_and_a_measured_disturbance_run_as_in_python(tmp_path: Path) -> None:
    case, plant = BasinCase(), Basin()
    export(Feedforward(plant.signals).eval(), tmp_path / "feedforward.onnx", case="basin", provenance={})
    controller = Controller(tmp_path / "feedforward.onnx")
    told = about(case, [controller], None)
    assert told["beside"] == ["feedforward", "feedforward"]
    write_one_file(tmp_path / "basin.html", Playground(told, plant_graphs(plant), [controller]), kept())
    with launched() as browser:
        page = browser.new_page()
        page.goto((tmp_path / "basin.html").as_uri())
        expect(page.locator("body")).to_have_attribute("data-ready", "yes")
        expect(page.locator("#title")).to_have_text(plant.title)
        page.select_option("#test", index=1)
        page.evaluate(f"playground.steps({CHANGE})")
        rain = page.locator('[data-field="DV rain"]')
        rain.fill("3")
        rain.press("Enter")
        refusal = page.locator("#disturbances .refusal").first
        expect(refusal).to_have_text("the measured disturbance rain = 3 l/s is outside [0, 1] l/s")
        for name, value in (("DV rain", "0.5"), ("SP T", "33"), ("SP h", "4.5")):
            page.locator(f'[data-field="{name}"]').fill(value)
            page.locator(f'[data-field="{name}"]').press("Enter")
        page.evaluate(f"playground.steps({END - CHANGE})")
        expect(page.locator('[data-chart="rain"]')).to_be_visible()
        columns = page.evaluate("playground.simulation.columns")

    loop = ControlLoop(controller, sp=[4.0, 30.0], mv=plant.start[1], mode=Mode.AUTO, recover_after=5)
    x, mv = plant.start
    for k in range(END):
        dv = np.array([0.3 if k < CHANGE else 0.5 if k < 60 else 0.7])
        if k == CHANGE:
            loop.set_sp([4.5, 33.0])
        command = loop.scan(Sample(pv=x, mv_applied=mv, dv=dv))
        theirs = [columns[f"{name}"][k] for name in ("true A h", "true A T", "mv A hot", "mv A cold", "dv rain")]
        np.testing.assert_allclose(theirs, [*x, *command.mv, *dv], rtol=1e-9)
        assert columns["info B rain_change"][k] == pytest.approx(command.info[0], abs=1e-12)  # type: ignore[index]
        mv = command.mv
        x = plant.step(x, mv, dv, plant.parameters())
