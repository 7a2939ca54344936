"""A law and its manifest as one .onnx file, compared with the law before it is written."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

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
from serving.controller import Controller, Step
from serving.errors import LoopwrightError
from serving.manifest import SENSITIVE, Manifest, Signal

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
    runtime that will serve it, and renamed only after each of 1,000 steps of a closed loop agrees with the torch
    module, see ``parity_gate``. Where the loop amplifies rounding, the manifest's provenance says after how many steps
    two machines part, ``sensitive_after_steps``.

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
        parity = parity_gate(law, controller, drive=drive)
        if parity.parts_after is not None:
            manifest = replace(manifest, provenance={**provenance, SENSITIVE: parity.parts_after})
            draft.write_bytes(assembled(model.SerializeToString(), manifest))
    write_sidecar(path, manifest)
    return manifest


class Parity(NamedTuple):
    """How far a law and its file are apart.

    ``worst`` difference of MV and state in a step, relative; ``parts_after``: steps after which runs of both, each
    going on from its own state, differ by more than 1e-9; None where they never do.
    """

    worst: float
    parts_after: int | None


def parity_gate(
    law: ControlLaw,
    controller: Controller,
    *,
    steps: int | None = None,
    drive: Callable[[Array], Array] | None = None,
) -> Parity:
    """The law and its controller over a closed loop, each step from the same state.

    So a wrong graph is told from a loop that amplifies rounding: that is a property of the law, which every host of the
    file shares. A second run of the controller goes on from its own state, and tells after how many steps such a loop
    parts. With ``drive`` the process variables are the plant's under the controller's MV; without, they walk at random.

    ``steps`` are GATE_STEPS unless given. Differences are relative to each entry's largest value over the loop; 1e-13
    of the largest number anywhere is allowed beside it, because an output that ought to be zero is rounding alone. For
    MV and state "anywhere" means among themselves: a large entry of info excuses nothing there.

    Raises ExportError where a step differs by more than 1e-9, where an entry of info differs by more than 1e-6 of its
    largest value, and where either side has no number to give.
    """
    steps = GATE_STEPS if steps is None else steps
    signals, rng = law.signals, np.random.default_rng(0)
    courses = (_course(signals.sp, rng, 1 / 40), _course(signals.pv, rng), _course(signals.dv, rng))
    applied = own_applied = np.array([s.middle for s in signals.mv])
    state = own_state = np.zeros(law.n_state)
    pairs, alone = [], list[Array]()
    show = progress.steps("the exported file beside the law, step by step", steps)
    for k in range(steps):
        sp, pv, dv = (step() for step in courses)
        if drive is not None:
            pv = np.asarray(drive(applied), dtype=np.float64)
        with torch.inference_mode():
            ours = tuple(o.numpy() for o in law(*(torch.from_numpy(v) for v in (sp, pv, dv, applied, state))))
        try:
            theirs = controller.step(sp=sp, pv=pv, dv=dv, mv_applied=applied, state=state)
        except LoopwrightError as error:
            raise ExportError(f"law {law.name!r} fails at step {k} of the parity loop: {error}") from error
        pairs.append((np.concatenate(ours), np.concatenate(theirs)))
        if len(alone) == k:
            own = _alone(controller, {"sp": sp, "pv": pv, "dv": dv, "mv_applied": own_applied, "state": own_state})
            if own is not None:
                alone.append(np.concatenate(own[:2]))
                own_state, own_applied = own[1], own[0] if drive is None else theirs[0]
        state, applied = ours[1], ours[0] if drive is None else theirs[0]
        show(k + 1)
    torch_side, onnx_side = (np.array(side) for side in zip(*pairs, strict=True))
    scale = np.maximum(np.abs(torch_side), np.abs(onnx_side)).max(axis=0)
    names = [*(s.name for s in signals.mv), *(f"state[{i}]" for i in range(law.n_state)), *law.info]
    n_fed = len(names) - len(law.info)  # MV and state: what is fed back
    fed = np.arange(len(names)) < n_fed
    slack = 1e-13 * np.where(fed, scale[:n_fed].max(), scale.max())
    allowed = np.where(fed, GATE_TOLERANCE, INFO_TOLERANCE)
    relative = _apart(torch_side, onnx_side, scale, slack)
    if not (relative <= allowed).all():
        k = int(np.argmax(~(relative <= allowed).all(axis=1)))
        i = int(np.argmax(relative[k] / allowed))
        raise ExportError(
            f"law {law.name!r}: a step of the exported file and of the law differ by {relative[:, i].max():.1e} of the "
            f"largest value of {names[i]} within {steps} steps (allowed {allowed[i]:.0e}; at step {k}, the first "
            f"beyond, torch has {torch_side[k, i]:.17g}, onnxruntime {onnx_side[k, i]:.17g}): the graph is not the "
            "law; in a law of your own use float64 buffers for all constants, and no transposed constant in front of a "
            "vector product"
        )
    worst = float(relative[:, :n_fed].max())
    run = np.array(alone)
    beyond = ~(_apart(torch_side[: len(run), :n_fed], run, scale[:n_fed], slack[:n_fed]) <= GATE_TOLERANCE).all(axis=1)
    if beyond.any():
        return Parity(worst, int(beyond.argmax()))
    return Parity(worst, None if len(run) == steps else len(run))


def _alone(controller: Controller, inputs: Mapping[str, Array]) -> Step | None:
    """A step of the run that goes on from its own state; None where it has no number to give."""
    try:
        return controller.step(**inputs)
    except LoopwrightError:
        return None


def _apart(one: Array, other: Array, scale: Array, slack: Array) -> Array:
    """Differences (n, m) beyond ``slack`` (m,), relative to ``scale`` (m,)."""
    excess = np.abs(one - other) - slack
    return np.where(excess > 0, excess / np.maximum(scale, np.finfo(float).tiny), 0.0)


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
