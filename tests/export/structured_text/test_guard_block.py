"""The guard as Structured Text does in each scan of the kit what the loop of the runtime does."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import pytest
from identified_models import random_model
from kits import CASES, KEEP_STATE, name
from predictive_loops import law_of
from random_scans import random_rows
from structured_text.machine import Machine

from loopwright.pipeline.export.gate import export
from loopwright.pipeline.export.plain_code.lowering import lowered
from loopwright.pipeline.export.plain_code.self_test import MODES, KitInC, kit_in_c
from loopwright.pipeline.export.structured_text.elementary_functions import printed_function
from loopwright.pipeline.export.structured_text.guard_block import printed_guard, printed_operate_type
from loopwright.pipeline.export.structured_text.step_block import printed_step_block
from loopwright.serving import Controller
from loopwright.serving.conformance.kit import CHAIN_TOLERANCE
from loopwright.serving.manifest import Manifest
from loopwright.serving.modes import Mode

HISTORIES, SCANS = 2, 200
FILES = [min(case.glob("*.onnx")) for case in CASES]


def machine_of(file: Path) -> tuple[Machine, Manifest, KitInC]:
    controller, program = Controller(file), lowered(onnx.load(file))
    m, block = controller.manifest, printed_step_block(program, "tank")
    parts = [
        printed_operate_type(m, "tank"),
        *(printed_function("tank", f) for f in block.own_functions),
        block.text,
        *printed_guard(m, "tank", block),
    ]
    return Machine("\n".join(parts)), m, kit_in_c(controller, program)


def given_of(scan: Mapping[str, Any], m: Manifest) -> dict[str, Any]:
    """A scan of the kit as inputs of the guard."""
    sample = scan["sample"]
    given: dict[str, Any] = {
        "mode_command": MODES.index(Mode(scan["set_mode"])) if scan["set_mode"] else -1,
        "send_mv": scan["set_mv"] is not None,
        "mv_by_hand": [float.fromhex(v) for v in scan["set_mv"] or ["0x0p0"] * len(m.mv)],
        "unwritten": bool(scan["unwritten"]),
        "missed_periods": float(scan["missed"]),
        "sample_read": sample is not None,
    }
    if sample is None:
        return given
    given |= {n: [float.fromhex(v) for v in sample[n]] for n in ("pv", "dv") if n in m.inputs}
    given |= {"age_s": float.fromhex(sample["age_s"]), "has_mv_applied": bool(sample["mv_applied"])}
    if sample["mv_applied"]:
        given["mv_applied"] = [float.fromhex(v) for v in sample["mv_applied"]]
    return given


def wrong_scans(machine: Machine, m: Manifest, kit: KitInC) -> list[str]:
    guard = machine.make("tank_guard")
    guard.mode = MODES.index(Mode.AUTO)  # as the kit's loop begins
    guard.recover_after = int(kit.loop["recover_after"])
    guard.max_gap = float(kit.loop["max_gap"])
    sp = [float.fromhex(v) for v in kit.loop["sp"]]
    ranges = np.array([s.high - s.low for s in m.mv])
    wrong = []
    for k, scan in enumerate(kit.scans):
        guard(**({"sp": sp} if sp else {}), **given_of(scan, m))
        same = guard.mode == MODES.index(Mode(scan["mode"])) and (guard.why != 0) == scan["fault"]
        same = same and guard.writes == (scan["mv"] is not None) and not guard.sp_refused
        if scan["mv"] is not None:
            wanted = [float.fromhex(v) for v in scan["mv"]]
            same = same and bool((np.abs(np.array(guard.mv) - wanted) <= CHAIN_TOLERANCE * ranges).all())
        if not same:
            wrong.append(f"{k} {scan['what']}: mode {guard.mode}, why {guard.why}, {guard.writes} {guard.mv}")
    return wrong


@pytest.mark.parametrize("file", FILES, ids=name)
def test_scans_go_as_the_kit_says(file: Path) -> None:
    machine, m, kit = machine_of(file)
    assert len(kit.scans) > 100
    assert wrong_scans(machine, m, kit) == []


@pytest.mark.parametrize("file", KEEP_STATE, ids=name)
def test_random_histories_go_as_in_our_runtime(file: Path) -> None:
    machine, m, kit = machine_of(file)
    for seed in range(HISTORIES):
        rows = random_rows(Controller(file), seed, SCANS)
        assert wrong_scans(machine, m, replace(kit, scans=rows)) == [], f"history {seed}"


@pytest.fixture(scope="module")
def steered(tmp_path_factory: pytest.TempPathFactory) -> tuple[Machine, Manifest, KitInC]:
    """A law that operators steer, with readings that may be missing and a course to come."""
    model = random_model(5, n_y=2, n_mv=3, n_dv=1)
    file = tmp_path_factory.mktemp("law") / "law.onnx"
    law = law_of(model, horizon=8, operate={"y1.low": -0.5}, preview="course")
    export(law, file, case="made", provenance={})
    return machine_of(file)


def test_scans_of_a_law_that_operators_steer(steered: tuple[Machine, Manifest, KitInC]) -> None:
    assert wrong_scans(*steered) == []


def test_in_shadow_nothing_is_written_and_auto_begins_where_the_mv_stands() -> None:
    machine, m, _ = machine_of(FILES[0])
    guard = machine.make("tank_guard")
    given: dict[str, Any] = {"pv": [s.middle for s in m.pv], "has_mv_applied": True, "sample_read": True}
    given |= {"dv": [s.middle for s in m.dv]} if "dv" in m.inputs else {}
    for share in (0.4, 0.6, 0.7):
        back = [s.low + share * (s.high - s.low) for s in m.mv]
        guard(**given, mv_applied=back, mode_command=3)
        assert guard.mode == 3
        assert not guard.writes
        assert list(guard.mv) == back
    guard(**given | {"pv": [float("inf") for _ in m.pv]}, mv_applied=back, mode_command=1)
    assert guard.mode == 2  # HOLD
    assert guard.writes
    assert list(guard.mv) == back


def test_what_operators_may_not_change_is_refused(steered: tuple[Machine, Manifest, KitInC]) -> None:
    machine, m, _ = steered
    guard = machine.make("tank_guard")
    fields = machine.fields["tank_operate"]
    assert [getattr(guard.operate, f) for f in fields] == [e.default for e in m.operate]
    guard(pv=[0.0, 0.0], dv=[0.0], mv_applied=[0.0] * 3, mode_command=1)
    assert not guard.operate_refused
    low = next(k for k, e in enumerate(m.operate) if e.what == "low" and e.group == "mv")
    use = next(k for k, e in enumerate(m.operate) if e.what == "use")
    names = list(fields)
    for k, value in ((low, m.operate[low].high + 1.0), (use, 0.5), (low, m.operate[low].high)):
        held = getattr(guard.operate, names[k])
        setattr(guard.operate, names[k], value)
        high = next(i for i, e in enumerate(m.operate) if e.name == f"{m.operate[low].signal}.high")
        if value == m.operate[low].high:  # a lower limit above the upper one
            setattr(guard.operate, names[high], m.operate[high].low)
        before = list(guard.operate_used)
        guard()
        assert guard.operate_refused
        assert guard.operate_used == before
        setattr(guard.operate, names[k], held)
        setattr(guard.operate, names[high], m.operate[high].default)


FAULTS = {
    "age_s <= period_s": "age_s <= (LREAL#100.0 * period_s)",
    "    lost := TRUE;": "    lost := FALSE;",
    "restart := is_cold": "restart := FALSE",
}


@pytest.mark.parametrize("case", ["reversible_cstr", "thiosulfate_cstr"])
def test_a_faulty_guard_is_found(case: str) -> None:
    file = next(f for f in FILES if f.parent.name == case)
    controller, program = Controller(file), lowered(onnx.load(file))
    block = printed_step_block(program, "tank")
    kit = kit_in_c(controller, program)
    functions = [printed_function("tank", f) for f in block.own_functions]
    guard = "\n".join(printed_guard(controller.manifest, "tank", block))
    for right, wrong in FAULTS.items():
        assert guard.count(right) == 1, right
        text = "\n".join([*functions, block.text, guard.replace(right, wrong)])
        assert wrong_scans(Machine(text), controller.manifest, kit), wrong
