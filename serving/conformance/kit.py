"""The kit on disk: the controller file, its manifest, and ``vectors.json``."""

from __future__ import annotations

import json
import platform
import shutil
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from loopwright.serving.conformance.scans import Scanned, scanned, start
from loopwright.serving.conformance.steps import Answer, answered
from loopwright.serving.controller import Controller, runtime_version
from loopwright.serving.controller_file import sidecar
from loopwright.serving.errors import ContractError, LoopwrightError
from loopwright.serving.guard import READ_BACK_MARGIN, InRange, Sample

Array: TypeAlias = NDArray[np.float64]


def written(values: Iterable[float]) -> list[str]:
    """Each value as ``float.hex`` writes it: 0x1.8000000000000p+1, nan, inf, -inf."""
    return [float(value).hex() for value in values]


def read(texts: object, where: str) -> Array:
    """The values (n,) that ``written`` wrote; ContractError names ``where`` if one is no such number."""
    if not isinstance(texts, list):
        raise ContractError(f"{where} is {str(texts)[:60]!r}; it must be a list of hexadecimal floats as text")
    try:
        return np.array([float.fromhex(text) for text in texts], dtype=np.float64)
    except (TypeError, ValueError, OverflowError) as error:
        raise ContractError(f"{where} holds no hexadecimal float: {error}") from error


def read_all(row: Mapping[str, Any], where: str) -> dict[str, Array]:
    """Each entry of ``row`` by ``read``."""
    return {name: read(texts, f"{where}.{name}") for name, texts in row.items()}


# ------------------------------------------------------------------------------------------------------------- the kit
# Version of the format. 1 began its scans at an MV that was told, so it shows nothing of a start without one; up to 2
# every command arrived, so it shows nothing of what follows one that did not.
KIT = 3
VECTORS = "vectors.json"
TOLERANCE = 1e-6  # share of an entry's scale
PASS = (
    "Start with a state of zeros. A step with cold = true starts from zeros again, every other from the state_next "
    "of the last step that was not refused.",
    "A step with refused = input must be refused because a value is not finite, one with refused = output because "
    "the law's result may not be used. The state stays as it was, as the next step shows.",
    f"Difference: |yours - ours| / scale, of every entry of mv, state_next and info. At most {TOLERANCE:g} passes.",
    "The same release of onnxruntime on the same kind of processor must give the same bits: the difference is 0. "
    "Between releases, processors and WebAssembly the last digits differ, which the 300 chained steps may amplify.",
    "A scan is one period of the loop around the controller. Mode and fault must be equal, mv as above. "
    "sample = null: the plant could not be read. mv_applied = null: there is no read-back. "
    "missed: so many periods passed before the scan without one.",
    "unwritten = true: the command of the scan before did not reach the plant; your loop learns it before this scan. "
    "Somebody may have moved the MV: the next sound read-back is where it stands, also by hand and in a sample that is "
    "refused for another reason. Without any read-back the MV before that command stays.",
    "The loop is not told where the MV stands (loop: mv = null). Until a good sample has a read-back, nothing may be "
    "written (mv = null); that read-back is where the loop begins. Only then a fault holds the last MV.",
    "Every number is a hexadecimal float as C's printf writes it with %a and strtod reads it, or nan, inf, -inf.",
)


def write_kit(controller: Controller, folder: Path) -> dict[str, Any]:
    """Write the kit into ``folder``, which is made if it is not there, and return what ``vectors.json`` holds.

    Raises LoopwrightError if the folder cannot be written.
    """
    vectors = vectors_of(controller)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        copy = folder / controller.path.name
        if not (copy.exists() and copy.samefile(controller.path)):
            shutil.copyfile(controller.path, copy)
        copy.with_suffix(".json").write_text(sidecar(controller.manifest, controller.sha256), encoding="utf-8")
        rows = json.dumps(vectors, allow_nan=False).replace('{"part"', '\n{"part"').replace('{"what"', '\n{"what"')
        (folder / VECTORS).write_text(rows + "\n", encoding="utf-8")
    except OSError as error:
        raise LoopwrightError(f"the kit cannot be written to {folder}: {error.strerror or error}") from error
    return vectors


def vectors_of(controller: Controller) -> dict[str, Any]:
    """The content of ``vectors.json``, ready for JSON."""
    m, steps, scans, begin = controller.manifest, answered(controller), scanned(controller), start(controller.manifest)
    return {
        "kit": KIT,
        "case": m.case,
        "law": m.law,
        "file": controller.path.name,
        "sha256": controller.sha256,
        "made_with": {
            "onnxruntime": runtime_version(),
            "processor": platform.machine(),
            "system": platform.system(),
        },
        "pass": list(PASS),
        "tolerance": TOLERANCE.hex(),
        "scale": _scale(controller, steps),
        "steps": [_step_row(m.inputs, answer) for answer in steps],
        "loop": {
            "sp": written(begin.sp),
            "mv": None,
            "recover_after": begin.recover_after,
            "max_gap": begin.max_gap,
            "pv_margin": InRange(m.pv).margin.hex(),
            "read_back_margin": READ_BACK_MARGIN.hex(),
            "max_age_s": m.period_s.hex(),
        },
        "scans": [_scan_row(row) for row in scans],
    }


def _scale(controller: Controller, answers: list[Answer]) -> dict[str, list[str]]:
    """By what each entry's difference is divided: an MV's range, else the entry's largest magnitude in the vectors."""
    taken = [answer.step for answer in answers if answer.step is not None]
    scale = {"mv": written(s.high - s.low for s in controller.manifest.mv)}
    for name, rows in (("state_next", [s.state for s in taken]), ("info", [s.info for s in taken])):
        largest = np.abs(rows).max(axis=0)
        scale[name] = written(np.where(largest > 0, largest, 1.0).tolist())
    return scale


def _step_row(inputs: tuple[str, ...], answer: Answer) -> dict[str, Any]:
    given = answer.given
    row: dict[str, Any] = {"part": given.part, "cold": given.cold}
    row["given"] = {name: written(given.inputs[name]) for name in inputs if name != "state"}
    if answer.step is None:
        return row | {"refused": answer.refused}
    mv, state, info = answer.step
    return row | {"gives": {"mv": written(mv), "state_next": written(state), "info": written(info)}}


def _scan_row(row: Scanned) -> dict[str, Any]:
    scan, command = row.scan, row.command
    return {
        "what": scan.what,
        "set_mode": None if scan.set_mode is None else str(scan.set_mode),
        "unwritten": scan.unwritten,
        "missed": scan.missed,
        "sample": None if scan.sample is None else _sample_row(scan.sample),
        "mode": str(command.mode),
        "fault": bool(command.reason),
        "mv": written(command.mv) if command.writes else None,
    }


def _sample_row(sample: Sample) -> dict[str, Any]:
    return {
        "pv": written(sample.pv),
        "dv": written(sample.dv),
        "mv_applied": None if sample.mv_applied is None else written(sample.mv_applied),
        "age_s": float(sample.age_s).hex(),
    }
