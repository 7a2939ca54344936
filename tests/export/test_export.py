"""What is written is what was designed: exact constants, the same loop, nothing of this machine inside."""

from __future__ import annotations

import getpass
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import pytest
import torch
from onnx_graphs import narrow as in_float32
from quick_laws import STEPS_OF_GATE
from torch import Tensor

from loopwright.pipeline.errors import ExportError
from loopwright.pipeline.export import gate
from loopwright.pipeline.export.controller_file import with_evidence
from loopwright.pipeline.export.gate import GATE_TOLERANCE, export, parity_gate
from loopwright.pipeline.export.graph import law_graph
from loopwright.pipeline.laws import ControlLaw
from loopwright.pipeline.plants.simulator import Signals
from loopwright.serving import Controller, Signal
from loopwright.serving.conformance.kit import vectors_of
from loopwright.serving.controller_file import TRAILER_BYTES, file_digest

pytest_plugins = ["small_laws"]
MakeFormula = Callable[..., ControlLaw]
ONE = Signal("x", "-", -1e6, 1e6)


@pytest.fixture(autouse=True)
def whole_gate(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(gate, "GATE_STEPS", STEPS_OF_GATE)


def loop_signals(**changed: Any) -> Signals:
    values = {"period_s": 1.0, "sp": (ONE,), "pv": (ONE,), "dv": (), "mv": (ONE,), **changed}
    return Signals(**values)


def test_true_plant_may_drive_the_gate(pi_law: ControlLaw, pi_file: Path) -> None:
    level = np.array([0.5])
    seen: list[float] = []

    def drive(mv: np.ndarray) -> np.ndarray:
        seen.append(float(mv[0]))
        level[0] = np.clip(0.9 * level[0] + 0.002 * mv[0], 0, 2)
        return np.array([level[0], 300.0])

    assert parity_gate(pi_law, Controller(pi_file), drive=drive).worst <= GATE_TOLERANCE
    assert len(seen) == 1_000
    assert np.ptp(seen) > 1


def test_the_file_holds_the_fused_graph(pi_law: ControlLaw, pi_file: Path) -> None:
    written, _ = law_graph(pi_law)
    assert Controller(pi_file).summary.nodes < len(written.graph.node)


def test_python_floats_keep_their_53_bits(make_formula: MakeFormula, tmp_path: Path) -> None:
    """The exporter alone writes 0.1 as float32, takes 1e-9 for zero and 1.0000001 for one."""

    def formula(law: ControlLaw, sp: Tensor, pv: Tensor, dv: Tensor, mv_applied: Tensor, state: Tensor) -> Any:
        y = 0.1 * sp + 1e-9
        z = (pv * 1.0001 - 0.3).clamp(min=1e-300) / 0.7 + torch.where(sp > 0.11, 0.13, pv) ** 2.2 * 1e-6
        return law.limited(y + 1e-3 * z, mv_applied), state, torch.cat([y, z, torch.full_like(y, 0.19)], dim=-1)

    small = (Signal("x", "-", 0.0, 1e-6),)
    law = make_formula(formula, 0, ("y", "z", "c"), loop_signals(sp=small, pv=(Signal("y", "-", 0.0, 10.0),)))
    export(law, tmp_path / "f.onnx", case="none", provenance={})
    values = {
        float(v)
        for t in onnx.load(tmp_path / "f.onnx").graph.initializer
        for v in np.ravel(onnx.numpy_helper.to_array(t))
    }
    assert {0.1, 1e-9, 1.0001, 0.7, 1e-300, 0.19, 2.2} <= values
    step = Controller(tmp_path / "f.onnx").step(sp=1e-6, pv=3.0, mv_applied=0.0, state=[])
    expected = law(*(torch.tensor(v, dtype=torch.float64) for v in ([1e-6], [3.0], [], [0.0], [])))
    for ours, theirs in zip((step.mv, step.state, step.info), expected, strict=True):
        np.testing.assert_allclose(ours, theirs.numpy(), rtol=1e-15)


@pytest.mark.parametrize("n", [1, 3])
@pytest.mark.parametrize("factor", [lambda x: 0.1 * x, lambda x: x / 0.7], ids=["times", "over"])
@pytest.mark.parametrize("before", [False, True], ids=["behind", "before"])
def test_no_factor_beside_a_product_becomes_float32(
    make_formula: MakeFormula, tmp_path: Path, n: int, factor: Callable[[Tensor], Tensor], *, before: bool
) -> None:
    """onnxruntime fuses a factor of one element with a product, in an attribute of 24 bits."""
    into, out = torch.linspace(-1.0, 1.3, n).double()[None], torch.linspace(0.2, 1.1, n).double()[:, None]

    def formula(law: ControlLaw, sp: Tensor, pv: Tensor, dv: Tensor, mv_applied: Tensor, state: Tensor) -> Any:
        hidden = torch.tanh(1e-6 * sp) @ into + 0.0
        y = factor(torch.tanh(hidden)) @ out if before else factor(torch.tanh(hidden) @ out)
        return law.limited(mv_applied + torch.tanh(y), mv_applied), state, y

    law, file = make_formula(formula, 0, ("y",), loop_signals()), tmp_path / "f.onnx"
    export(law, file, case="none", provenance={})
    assert in_float32(onnx.load(file), tmp_path) == []
    sp = np.array([4e5])
    wanted = law(*map(torch.from_numpy, (sp, np.zeros(1), np.zeros(0), np.zeros(1), np.zeros(0))))[2]
    assert Controller(file).step(sp=sp, pv=0.0, mv_applied=0.0, state=[]).info == pytest.approx(
        wanted.numpy(), rel=1e-14
    )


def test_graph_has_only_what_the_law_uses(make_formula: MakeFormula, tmp_path: Path) -> None:
    """And an input may be handed through: the exporter alone would rename it, and the graph would lose it."""
    law = make_formula(lambda law, sp, pv, dv, mv_applied, state: (law.limited(sp, sp), state, sp), 0, ("sp",))
    manifest = export(law, tmp_path / "p.onnx", case="none", provenance={})
    graph = onnx.load(tmp_path / "p.onnx").graph
    assert manifest.inputs == ("sp",) == tuple(i.name for i in graph.input)
    assert [o.name for o in graph.output] == ["mv", "info"]
    step = Controller(tmp_path / "p.onnx").step(sp=1.5, pv=[0, 0], mv_applied=0, state=[])
    assert (step.mv.tolist(), step.state.shape, step.info.tolist()) == ([1.5], (0,), [1.5])


def test_file_is_self_contained_and_says_nothing_of_this_machine(pi_file: Path) -> None:
    data = pi_file.read_bytes()
    model = onnx.load_from_string(data)
    onnx.checker.check_model(model, full_check=True)
    assert model.ir_version <= 10
    assert all(o.version <= 21 for o in model.opset_import)
    assert not any(n.doc_string or n.metadata_props for n in model.graph.node)
    assert [p.key for p in model.metadata_props] == ["loopwright.manifest", "loopwright.sha256"]
    assert model.metadata_props[-1].value == file_digest(data[:-TRAILER_BYTES])
    for trace in (b".py", b"/site-packages", str(Path.home()).encode() + b"/", getpass.getuser().encode() + b"@"):
        assert trace not in data


def test_sidecar_repeats_the_manifest(pi_file: Path) -> None:
    sidecar = json.loads(pi_file.with_suffix(".json").read_text())
    assert sidecar.pop("sha256") == file_digest(pi_file.read_bytes())
    assert sidecar == json.loads(Controller(pi_file).manifest.to_json())


def test_evidence_changes_the_manifest_and_not_the_graph(pi_file: Path, tmp_path: Path) -> None:
    evidence = {"scenarios": {"sp_a": {"mae": 0.0701}}}
    manifest = with_evidence(pi_file, tmp_path / "out.onnx", evidence)
    before, after = Controller(pi_file), Controller(tmp_path / "out.onnx")
    assert after.manifest == manifest
    assert manifest.evidence == evidence
    old, new = onnx.load(pi_file), onnx.load(tmp_path / "out.onnx")
    assert old.graph.SerializeToString() == new.graph.SerializeToString()
    rng, state = np.random.default_rng(1), before.cold_state()
    for _ in range(20):
        feed = {"sp": rng.uniform(0, 2, 1), "pv": rng.uniform(0, 2, 2), "mv_applied": rng.uniform(0, 100, 1)}
        a, b = (c.step(**feed, state=state) for c in (before, after))
        assert all(np.array_equal(x, y) for x, y in zip(a, b, strict=True))
        state = a.state
    assert json.loads((tmp_path / "out.json").read_text())["evidence"] == evidence
    # The same evidence again gives the same bytes.
    with_evidence(tmp_path / "out.onnx", tmp_path / "again.onnx", evidence)
    assert (tmp_path / "again.onnx").read_bytes() == (tmp_path / "out.onnx").read_bytes()


def sorting(law: ControlLaw, sp: Tensor, pv: Tensor, dv: Tensor, mv_applied: Tensor, state: Tensor) -> Any:
    return torch.sort(pv, dim=-1).values[..., :1], state, sp[..., :0]


def narrow(law: ControlLaw, sp: Tensor, pv: Tensor, dv: Tensor, mv_applied: Tensor, state: Tensor) -> Any:
    return sp.to(torch.float32).exp().to(torch.float64), state, sp[..., :0]


def unlimited(law: ControlLaw, sp: Tensor, pv: Tensor, dv: Tensor, mv_applied: Tensor, state: Tensor) -> Any:
    return 1e3 * sp + 200, state, sp[..., :0]


def not_a_number(law: ControlLaw, sp: Tensor, pv: Tensor, dv: Tensor, mv_applied: Tensor, state: Tensor) -> Any:
    return law.limited(sp, sp), state, (sp - 5).log()


def branching(law: ControlLaw, sp: Tensor, pv: Tensor, dv: Tensor, mv_applied: Tensor, state: Tensor) -> Any:
    return (sp if sp.item() > 1 else -sp), state, sp[..., :0]


def ambiguous(law: ControlLaw, sp: Tensor, pv: Tensor, dv: Tensor, mv_applied: Tensor, state: Tensor) -> Any:
    return law.limited(0.1 * sp + 0.1000000001, sp), state, sp[..., :0]


def single(law: ControlLaw, sp: Tensor, pv: Tensor, dv: Tensor, mv_applied: Tensor, state: Tensor) -> Any:
    return sp.to(torch.float32), state, sp[..., :0]


def transposed(law: ControlLaw, sp: Tensor, pv: Tensor, dv: Tensor, mv_applied: Tensor, state: Tensor) -> Any:
    outer = pv.unsqueeze(-1) * pv
    return law.limited(sp, sp), state, (outer @ outer.transpose(-1, -2))[0, :1]


def transposed_before_a_difference(
    law: ControlLaw, sp: Tensor, pv: Tensor, dv: Tensor, mv_applied: Tensor, state: Tensor
) -> Any:
    """Fused all the same: onnxruntime moves the Transpose behind the difference."""
    a, b = pv.unsqueeze(-1) * pv, sp.unsqueeze(-1) + pv * pv.unsqueeze(-1)
    return law.limited(sp, sp), state, ((a.transpose(-1, -2) - b.transpose(-1, -2)) @ a)[0, :1]


@pytest.mark.parametrize(
    ("formula", "info", "message"),
    [
        (sorting, (), "operator .* is not on the list"),
        (narrow, (), "float32"),
        (unlimited, (), "valve = .* outside its range"),
        (not_a_number, ("x",), r"info\[0\] = nan"),
        (branching, (), "cannot be traced"),
        (ambiguous, (), "0.1, 0.1000000001 become one number"),
        (single, (), "gives mv as torch.float32"),
        (transposed, ("x",), "multiplies a transposed matrix, .* write the product as a sum"),
        (transposed_before_a_difference, ("x",), "multiplies a transposed matrix"),
        (lambda law, sp, *_: (law.limited(sp, sp), sp, sp[..., :0]), (), "gives state_next as .* must be .*\\(0,\\)"),
        (lambda law, sp, *_: (law.limited(sp, sp), sp), (), "gives 2 outputs"),
    ],
)
def test_refused_laws_leave_nothing_behind(
    make_formula: MakeFormula, tmp_path: Path, formula: Any, info: tuple[str, ...], message: str
) -> None:
    with pytest.raises(ExportError, match=message) as caught:
        export(make_formula(formula, 0, info), tmp_path / "new" / "law.onnx", case="none", provenance={})
    assert "\n" not in str(caught.value)
    assert not list(tmp_path.rglob("*.*"))


def test_a_law_of_single_vectors_passes_as_one_of_many_does(
    pi_law: ControlLaw, make_formula: MakeFormula, tmp_path: Path
) -> None:
    """A person's own law may sum over all it is given: its steps side by side differ, and one by one they decide."""

    def alone(law: ControlLaw, *inputs: Tensor) -> Any:
        mv, state, info = pi_law(*inputs)
        return mv + 0.0 * mv.sum(), state + inputs[1].sum() - inputs[1].sum(dim=-1, keepdim=True), info

    law, file = make_formula(alone, 2, ("error", "move")), tmp_path / "law.onnx"
    export(law, file, case="none", provenance={})
    assert parity_gate(law, Controller(file)) == (pytest.approx(0.0, abs=GATE_TOLERANCE), None)


def test_gate_tells_a_law_from_another(pi_law: ControlLaw, pi_file: Path, make_formula: MakeFormula) -> None:
    def off(law: ControlLaw, *inputs: Tensor) -> Any:
        mv, state, info = pi_law(*inputs)
        return law.limited(mv * (1 + 1e-8), inputs[3]), state, info

    with pytest.raises(ExportError, match=r"differ by .* of valve within .* \(allowed 1e-09; at step"):
        parity_gate(make_formula(off, 2, ("error", "move")), Controller(pi_file))


def test_a_law_that_amplifies_rounding_ships_and_says_so(make_formula: MakeFormula, tmp_path: Path) -> None:
    """A chaotic state (Ricker's map): the graph is right in each step, and two machines part after some tens."""

    def formula(law: ControlLaw, sp: Tensor, pv: Tensor, dv: Tensor, mv_applied: Tensor, state: Tensor) -> Any:
        grown = 20.0 * (state + 0.5) * torch.exp(-(state + 0.5))
        return law.limited(40.0 + state[..., :1], mv_applied), grown - 0.5, state[..., :1]

    file = tmp_path / "law.onnx"
    manifest = export(make_formula(formula, 1, ("it",)), file, case="none", provenance={"from": "a test"})
    parted = manifest.provenance["sensitive_after_steps"]
    assert 10 < parted < 500
    assert Controller(file).manifest == manifest
    assert json.loads(file.with_suffix(".json").read_text())["provenance"] == manifest.provenance
    # Its kit holds no chained run that is long enough for two hosts to part.
    lengths, since = [], 0
    for row in vectors_of(Controller(file))["steps"]:
        since = 1 if row["begins"] else since + 1
        lengths.append(since)
    assert 1 < max(lengths) < parted
    assert len(lengths) > 300


@pytest.mark.parametrize(
    ("wrong", "refused"),
    [
        (lambda move: move * (1 + 1.1e-8), False),  # what rounding makes of a ratio such as tau_i = Kp/Ki
        (lambda move: move * (1 + 1e-5), True),
        (lambda move: -move, True),
        (lambda move: torch.zeros_like(move), True),
    ],
)
def test_info_may_differ_by_rounding_and_not_in_meaning(
    pi_law: ControlLaw, pi_file: Path, make_formula: MakeFormula, wrong: Callable[[Tensor], Tensor], refused: bool
) -> None:
    def told(law: ControlLaw, *inputs: Tensor) -> Any:
        mv, state, info = pi_law(*inputs)
        return mv, state, torch.cat([info[..., :1], wrong(info[..., 1:])], dim=-1)

    law = make_formula(told, 2, ("error", "move"))
    if refused:
        with pytest.raises(ExportError, match=r"differ by .* of move within .* \(allowed 1e-06; at step"):
            parity_gate(law, Controller(pi_file))
    else:
        assert parity_gate(law, Controller(pi_file)) == (pytest.approx(0.0, abs=GATE_TOLERANCE), None)


def test_a_large_info_excuses_no_difference_in_mv_or_state(make_formula: MakeFormula, tmp_path: Path) -> None:
    """1e10 in info, of which 1e-13 is a thousandth: an MV off by that much is refused all the same."""

    def formula(shift: float) -> Any:
        def told(law: ControlLaw, sp: Tensor, pv: Tensor, dv: Tensor, mv_applied: Tensor, state: Tensor) -> Any:
            return law.limited(sp * 0.7 + shift, mv_applied), state, sp * 1e10

        return told

    small = (Signal("x", "-", 0.0, 1.0),)
    signals = loop_signals(sp=small, pv=small, mv=small)
    export(make_formula(formula(0.0), 0, ("large",), signals), tmp_path / "law.onnx", case="none", provenance={})
    with pytest.raises(ExportError, match=r"of x within .* \(allowed 1e-09; at step"):
        parity_gate(make_formula(formula(5e-4), 0, ("large",), signals), Controller(tmp_path / "law.onnx"))
