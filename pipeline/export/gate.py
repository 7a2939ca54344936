"""A law and its manifest as one .onnx file, compared with the law before it is written."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch

from loopwright.pipeline.engine import progress
from loopwright.pipeline.errors import ExportError
from loopwright.pipeline.export.controller_file import file_bytes, write_sidecar
from loopwright.pipeline.export.fusion import fused
from loopwright.pipeline.export.graph import check_operators, example_inputs, law_graph
from loopwright.pipeline.files import draft_of
from loopwright.pipeline.laws.base import ControlLaw
from loopwright.pipeline.plants.simulator import Array
from loopwright.serving.controller import Controller
from loopwright.serving.errors import LoopwrightError
from loopwright.serving.manifest import INPUTS, SENSITIVE, Manifest, Signal
from loopwright.serving.operating import Operate
from loopwright.serving.preview.ahead import AheadInput
from loopwright.serving.preview.differences import Differences

GATE_STEPS = 1_000  # of the loop in which a law and its file are compared
GATE_TOLERANCE = 1e-9  # largest difference of an MV or a state, relative to its largest value
STEPS_TOGETHER = 200  # steps of a law side by side: more would leave the caches
INFO_TOLERANCE = 1e-6
"""Tolerance of info. It is shown and never fed back, so a difference cannot grow; but entries such as
tau_i = Kp/Ki are ratios of small differences, which carry the rounding of their terms a thousand times enlarged. One
part in a million of an entry's largest value is far below what a wrong formula changes, and below what anybody reads
off."""


def export(
    law: ControlLaw,
    path: str | Path,
    *,
    case: str,
    provenance: Mapping[str, Any],
    drive: Callable[[Array], Array] | None = None,
) -> Manifest:
    """Write ``law`` as one ONNX graph with its manifest, and the manifest again as .json beside it.

    The graph is fused, see ``loopwright.pipeline.export.fusion``, and written to a draft. The draft is loaded by the
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
    check_operators(law.name, model)
    manifest = Manifest(
        **{name: getattr(law.signals, name) for name in ("period_s", "sp", "pv", "dv", "mv")},
        case=case,
        law=law.name,
        n_state=law.n_state,
        info=tuple(law.info),
        inputs=inputs,
        provenance=dict(provenance),
        evidence={},
        operate=law.operate,
        ahead=law.ahead,
    )
    with draft_of(path) as draft:
        draft.write_bytes(file_bytes(model.SerializeToString(), manifest))
        try:
            controller = Controller(draft)
        except LoopwrightError as error:
            reason = str(error).removeprefix(f"{draft}: ")
            raise ExportError(f"law {law.name!r} does not make a controller: {reason}") from error
        parity = parity_gate(law, controller, drive=drive)
        if parity.parts_after is not None:
            manifest = replace(manifest, provenance={**provenance, SENSITIVE: parity.parts_after})
            draft.write_bytes(file_bytes(model.SerializeToString(), manifest))
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
    file shares. A second run of the controller rounds as the law does in torch, goes on from its own state, and tells
    after how many steps such a loop parts. With ``drive`` the process variables are the plant's under the controller's
    MV; without, they walk at random.

    ``steps`` are GATE_STEPS unless given. Differences are relative to each entry's largest value over the loop; 1e-13
    of the largest number anywhere is allowed beside it, because an output that ought to be zero is rounding alone. For
    MV and state "anywhere" means among themselves: a large entry of info excuses nothing there.

    The law's steps from the visited states are independent of each other, so that they are computed side by side; where
    these differ, or the law takes single vectors alone, they are computed one by one, which decides.

    Raises ExportError where a step differs by more than 1e-9, where an entry of info differs by more than 1e-6 of its
    largest value, and where either side has no number to give.
    """
    steps = GATE_STEPS if steps is None else steps
    given, onnx_side = _visited(law, controller, steps, drive)
    n_fed = len(law.signals.mv) + law.n_state  # MV and state: what is fed back
    fed = np.arange(n_fed + len(law.info)) < n_fed
    allowed = np.where(fed, GATE_TOLERANCE, INFO_TOLERANCE)
    for torch_side in _of_law(law, given):
        scale = np.maximum(np.abs(torch_side), np.abs(onnx_side)).max(axis=0)
        slack = 1e-13 * np.where(fed, scale[:n_fed].max(), scale.max())
        relative = _apart(torch_side, onnx_side, scale, slack)
        if (relative <= allowed).all():
            break
    else:
        names = [*(s.name for s in law.signals.mv), *(f"state[{i}]" for i in range(law.n_state)), *law.info]
        k = int(np.argmax(~(relative <= allowed).all(axis=1)))
        i = int(np.argmax(relative[k] / allowed))
        raise ExportError(
            f"law {law.name!r}: a step of the exported file and of the law differ by {relative[:, i].max():.1e} of the "
            f"largest value of {names[i]} within {steps} steps (allowed {allowed[i]:.0e}; at step {k}, the first "
            f"beyond, torch has {torch_side[k, i]:.17g}, onnxruntime {onnx_side[k, i]:.17g}): the graph is not the "
            "law; in a law of your own use float64 buffers for all constants, and no transposed constant in front of a "
            "vector product"
        )
    run = _parted(controller, given, (torch_side - onnx_side)[:, :n_fed], with_drive=drive is not None)
    known = onnx_side[: len(run), :n_fed]
    beyond = ~(_apart(known, run, scale[:n_fed], slack[:n_fed]) <= GATE_TOLERANCE).all(axis=1)
    parts_after = int(beyond.argmax()) if beyond.any() else None if len(run) == steps else len(run)
    return Parity(float(relative[:, :n_fed].max()), parts_after)


def _visited(
    law: ControlLaw, controller: Controller, steps: int, drive: Callable[[Array], Array] | None
) -> tuple[dict[str, Array], Array]:
    """Inputs of each step of the controller's loop, (steps, n) each, and its answers (steps, m)."""
    signals, rng = law.signals, np.random.default_rng(0)
    courses = {"sp": _course(signals.sp, rng, 1 / 40), "pv": _course(signals.pv, rng), "dv": _course(signals.dv, rng)}
    applied, state = np.array([s.middle for s in signals.mv]), np.zeros(law.n_state)
    if law.operate:
        courses |= {"operate": _operated(Operate(law.operate), rng), "fresh": _freshness(len(signals.pv), rng)}
    known = None if law.ahead is None else _known_future(law.ahead, rng)
    given, answers = [], list[Array]()
    show = progress.steps("the exported file beside the law, step by step", steps)
    for k in range(steps):
        now = {name: course() for name, course in courses.items()} | {"mv_applied": applied, "state": state}
        if drive is not None:
            now["pv"] = np.asarray(drive(applied), dtype=np.float64)
        if known is not None:
            now["ahead"] = known(np.concatenate([now["sp"], now["dv"]]))
        try:
            step = controller.step(**now)
        except LoopwrightError as error:
            raise ExportError(f"law {law.name!r} fails at step {k} of the parity loop: {error}") from error
        given.append(now)
        answers.append(np.concatenate(step))
        applied, state = step.mv, step.state
        show(k + 1)
    return {name: np.array([now[name] for now in given]) for name in given[0]}, np.array(answers)


def _of_law(law: ControlLaw, given: Mapping[str, Array]) -> Iterator[Array]:
    """The law's answers (steps, m) to what the controller was given: side by side, then one by one."""
    inputs = [torch.from_numpy(given[name]) for name in INPUTS if name in given]
    n = len(inputs[0])
    if "ahead" in given and "operate" not in given:  # it stands behind these two
        inputs[-1:-1] = [torch.zeros(n, 0, dtype=torch.float64)] * 2
    for size in (STEPS_TOGETHER, 0):
        rows = [slice(k, k + size) for k in range(0, n, size)] if size else range(n)
        try:
            with torch.inference_mode():
                found = [torch.cat(law(*(v[k] for v in inputs)), dim=-1) for k in rows]
        except (RuntimeError, IndexError, ValueError):
            if size:
                continue
            raise
        answers = np.concatenate(found) if size else np.stack(found)
        if len(answers) == n:
            yield answers


def _parted(controller: Controller, given: Mapping[str, Array], rounding: Array, *, with_drive: bool) -> Array:
    """MV and state (n, m) of a run that goes on from its own state, as on a host that rounds as torch does.

    To each of its steps the ``rounding`` (steps, m) is added by which torch differs there. It ends where it has no
    number to give. ``with_drive`` it is given the MV of the first run, whose plant's outputs it sees.
    """
    n_mv, run = given["mv_applied"].shape[1], list[Array]()
    for k, missed in enumerate(rounding):
        now = {name: of[k] for name, of in given.items()}
        if run:
            now["state"] = run[-1][n_mv:]
            if not with_drive:
                now["mv_applied"] = run[-1][:n_mv]
        try:
            step = controller.step(**now)
        except LoopwrightError:
            break
        run.append(np.concatenate(step[:2]) + missed)
    return np.array(run).reshape(-1, rounding.shape[1])


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


OPERATED = 1 / 25  # probability a step that an operator changes something
NOT_FRESH = 0.1  # of readings that are not fresh


def _operated(operate: Operate, rng: np.random.Generator) -> Callable[[], Array]:
    """The defaults, and by and by other values within their engineered ranges: as operators change them."""
    at = operate.default.copy()

    def step() -> Array:
        nonlocal at
        if rng.uniform() < OPERATED:
            at = operate.drawn(rng)
        return at

    return step


def _freshness(n: int, rng: np.random.Generator) -> Callable[[], Array]:
    return lambda: (rng.uniform(size=n) > NOT_FRESH).astype(np.float64)


KNOWN_ANEW = 1 / 10  # probability a step that somebody gives another course
UNKNOWN = 0.3  # of courses that say nothing


def _known_future(ahead: AheadInput, rng: np.random.Generator) -> Callable[[Array], Array]:
    """Courses within the signals' ranges, a step or straight over the horizon, as differences from present values."""
    differences, n = Differences(ahead), len(ahead.signals)
    low, high = (np.array([getattr(s, end) for s in ahead.signals]) for end in ("low", "high"))
    at = np.arange(1, ahead.horizon + 1)[:, None]
    target, begin, takes = low, np.ones(n), np.full(n, np.inf)

    def step(present: Array) -> Array:
        nonlocal target, begin, takes
        if rng.uniform() < KNOWN_ANEW:
            target, begin = rng.uniform(low, high), rng.integers(1, ahead.horizon + 1, n).astype(np.float64)
            takes = np.where(rng.uniform(size=n) < UNKNOWN, np.inf, rng.choice([1.0, float(ahead.horizon)], n))
        share = np.clip((at - begin + 1) / takes, 0.0, 1.0)
        return differences.within((share * (target - present)).ravel(), present)

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
