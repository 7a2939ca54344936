"""A law and its manifest as one .onnx file, compared with the law before it is written."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch

from pipeline.engine import progress
from pipeline.errors import ExportError
from pipeline.export.controller_file import assembled, write_sidecar
from pipeline.export.fusion import fused
from pipeline.export.graph import example_inputs, law_graph
from pipeline.export.operators import check_operators
from pipeline.files import draft_of
from pipeline.laws.base import ControlLaw
from pipeline.plants.simulator import Array
from serving.controller import Controller
from serving.errors import LoopwrightError
from serving.manifest import Manifest, Signal

GATE_STEPS = 1_000
GATE_TOLERANCE = 1e-9
INFO_TOLERANCE = 1e-6
"""Of info. It is shown and never fed back, so a difference cannot grow; but entries such as tau_i = Kp/Ki are
ratios of small differences, which carry the rounding of their terms a thousand times enlarged. One part in a
million of an entry's largest value is far below what a wrong formula changes, and below what anybody reads off."""


def export(
    law: ControlLaw,
    path: str | Path,
    *,
    case: str,
    provenance: Mapping[str, Any],
    drive: Callable[[Array], Array] | None = None,
) -> Manifest:
    """Write ``law`` as one ONNX graph with its manifest, and the manifest again as .json beside it.

    The graph is fused, see ``pipeline.export.fusion``, and written to a draft. The draft is loaded by the
    runtime that will serve it, and renamed only after a closed loop of 1,000 steps agrees with the torch
    module, see ``parity_gate``.

    Parameters
    ----------
    law
        The law in engineering units, all its numbers float64.
    path
        The .onnx file; its folder is made if need be.
    case
        Name of the case that the controller belongs to.
    provenance
        JSON-ready values for the manifest, whose evidence is empty until the file is validated.
    drive
        ``mv (n_mv,) -> pv (n_pv,)``: the plant in the loop, one period further with each call.
        Without it the process variables walk at random over their ranges.

    Raises
    ------
    ExportError
        The law uses an operator that a controller may not, computes in float32, gives the wrong
        shapes, or its graph differs from it. Nothing is written then.
    """
    path = Path(path)
    law = law.eval()
    _check_shapes(law)
    written, inputs = law_graph(law)
    model = fused(written)
    check_operators(law, model)
    manifest = Manifest(
        **{name: getattr(law.signals, name) for name in ("period_s", "sp", "pv", "dv", "mv")},
        case=case,
        law=law.name,
        n_state=law.n_state,
        info=tuple(law.info),
        inputs=inputs,
        provenance=dict(provenance),
        evidence={},
    )
    with draft_of(path) as draft:
        draft.write_bytes(assembled(model.SerializeToString(), manifest))
        try:
            controller = Controller(draft)
        except LoopwrightError as error:
            reason = str(error).removeprefix(f"{draft}: ")
            raise ExportError(f"law {law.name!r} does not make a controller: {reason}") from error
        parity_gate(law, controller, drive=drive)
    write_sidecar(path, manifest)
    return manifest


def parity_gate(
    law: ControlLaw,
    controller: Controller,
    *,
    steps: int | None = None,
    drive: Callable[[Array], Array] | None = None,
) -> float:
    """Largest difference between the law and its controller over a closed loop in MV and state, relative.

    The state is fed back from each side's own outputs, so that a difference could grow; so is the applied MV
    without a plant. With ``drive`` both sides have the plant's process variables and the MV that it received, so
    that a loop that rings does not amplify rounding.

    ``steps`` are GATE_STEPS unless given. Relative to each entry's largest value over the loop; 1e-13 of the largest
    number anywhere is allowed beside it, because an output that ought to be zero is rounding alone. For MV and state
    "anywhere" means among themselves: a large entry of info excuses nothing there.

    Raises ExportError where it exceeds 1e-9, where an entry of info differs by more than 1e-6 of its
    largest value, and where either side has no number to give.
    """
    steps = GATE_STEPS if steps is None else steps
    signals, rng = law.signals, np.random.default_rng(0)
    courses = (_course(signals.sp, rng, 1 / 40), _course(signals.pv, rng), _course(signals.dv, rng))
    mv = np.array([s.middle for s in signals.mv])
    ours = theirs = (mv, np.zeros(law.n_state), np.zeros(len(law.info)))
    pairs = []
    show = progress.steps("the exported file beside the law, step by step", steps)
    for k in range(steps):
        sp, pv, dv = (step() for step in courses)
        if drive is not None:
            pv = np.asarray(drive(theirs[0]), dtype=np.float64)
        with torch.inference_mode():
            applied = ours[0] if drive is None else theirs[0]
            ours = tuple(o.numpy() for o in law(*(torch.from_numpy(v) for v in (sp, pv, dv, applied, ours[1]))))
        try:
            theirs = controller.step(sp=sp, pv=pv, dv=dv, mv_applied=theirs[0], state=theirs[1])
        except LoopwrightError as error:
            raise ExportError(f"law {law.name!r} fails at step {k} of the parity loop: {error}") from error
        show(k + 1)
        pairs.append((np.concatenate(ours), np.concatenate(theirs)))
    torch_side, onnx_side = (np.array(side) for side in zip(*pairs, strict=True))
    scale = np.maximum(np.abs(torch_side), np.abs(onnx_side)).max(axis=0)
    names = [*(s.name for s in signals.mv), *(f"state[{i}]" for i in range(law.n_state)), *law.info]
    n_fed = len(names) - len(law.info)  # MV and state: what is fed back
    fed = np.arange(len(names)) < n_fed
    allowed = np.where(fed, GATE_TOLERANCE, INFO_TOLERANCE)
    excess = np.abs(torch_side - onnx_side) - 1e-13 * np.where(fed, scale[:n_fed].max(), scale.max())
    relative = np.where(excess > 0, excess / np.maximum(scale, np.finfo(float).tiny), 0.0)
    if not (relative <= allowed).all():
        k = int(np.argmax(~(relative <= allowed).all(axis=1)))
        i = int(np.argmax(relative[k] / allowed))
        raise ExportError(
            f"law {law.name!r}: the exported file and the law part by {relative[:, i].max():.1e} of the largest value "
            f"of {names[i]} within {steps} steps (allowed {allowed[i]:.0e}; at step {k}, the first beyond, torch has "
            f"{torch_side[k, i]:.17g}, onnxruntime {onnx_side[k, i]:.17g}): a law that amplifies rounding would act "
            "differently on every machine; a longer sampling period often cures it, and in a law of your own float64 "
            "buffers for all constants, and no transposed constant in front of a vector product"
        )
    return float(relative[:, :n_fed].max())


def _course(signals: Sequence[Signal], rng: np.random.Generator, jumps: float | None = None) -> Callable[[], Array]:
    """A random walk over the ranges of some signals, reflected at their ends; or jumps of this probability a step."""
    low, span = (np.array([(s.low, s.high - s.low) for s in signals]).reshape(-1, 2)).T
    at = rng.uniform(size=len(signals))  # in units of the range

    def step() -> Array:
        nonlocal at
        if jumps is None:
            at = np.abs(at + 0.05 * rng.standard_normal(len(at)))
            at = np.where(at > 1, np.maximum(2 - at, 0), at)
        elif rng.uniform() < jumps:
            at = rng.uniform(size=len(at))
        return np.asarray(low + span * at)

    return step


def _check_shapes(law: ControlLaw) -> None:
    """ExportError unless the law maps float64 vectors to float64 vectors of the sizes that it declares."""
    wanted = {"mv": len(law.signals.mv), "state_next": law.n_state, "info": len(law.info)}
    try:
        with torch.no_grad():
            outputs = law(*example_inputs(law))
    except RuntimeError as error:
        raise ExportError(f"law {law.name!r} cannot be stepped on vectors: {error}") from error
    if len(outputs) != len(wanted):
        raise ExportError(f"law {law.name!r} gives {len(outputs)} outputs; it must give {', '.join(wanted)}")
    for (name, n), output in zip(wanted.items(), outputs, strict=True):
        if output.dtype != torch.float64 or output.shape != (n,):
            raise ExportError(
                f"law {law.name!r} gives {name} as {output.dtype} of shape {tuple(output.shape)}; "
                f"it must be torch.float64 of shape ({n},)"
            )
