"""The kit on disk, the controller file, its manifest and ``vectors.json``, and a host's answers compared with it."""

from __future__ import annotations

import json
import platform
import shutil
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from math import inf
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from loopwright.serving.conformance.batch_of_one import batch_of_one
from loopwright.serving.conformance.scans import Scanned, scanned, start
from loopwright.serving.conformance.steps import OUTPUTS, StepResult, answered, beginnings
from loopwright.serving.controller import Controller, runtime_version
from loopwright.serving.controller_file import BATCH_SUFFIX, file_digest, sidecar
from loopwright.serving.errors import ContractError, LoopwrightError
from loopwright.serving.guard import READ_BACK_MARGIN, InRange, Sample
from loopwright.serving.words import plain

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
KIT = 6  # version of the format: 5 had no set_mv, 4 no scan in SHADOW, and up to 3 no step gave its state
VECTORS = "vectors.json"
KIT_TOLERANCE = 1e-9  # share of an entry's scale, in one step from the kit's state: WebAssembly differs by up to 3e-10
CHAIN_TOLERANCE = 1e-6  # share of an entry's scale, chained: a thousandfold before the chain begins again
PASS = (
    "steps: set your state to given.state and run ONE step; cold = true says that this state is zeros. Each step "
    "stands by itself. Compare every entry of mv, state_next and info: |yours - ours| / scale is at most "
    f"{KIT_TOLERANCE:g}.",
    "The same release of onnxruntime on the same kind of processor must give the same bits: the difference is 0. "
    "Between releases, processors and WebAssembly the last digits differ.",
    "A step with refused = input must be refused because a value is not finite, one with refused = output because "
    "the law's result may not be used.",
    "chained: run the same steps again. A step with begins = true starts from given.state, every other from your own "
    "state_next of the last step that was not refused: a refused step leaves the state as it was. The largest "
    f"difference is the sensitivity; at most {CHAIN_TOLERANCE:g} passes. Last digits that a law amplifies stay below "
    "it, because the chain begins again before they grow too far; a state that is not carried on does not.",
    "A scan is one period of the loop around the controller. Mode and fault must be equal, mv as in the chained run. "
    "sample = null: the plant could not be read. mv_applied = null: there is no read-back. "
    "missed: so many periods passed before the scan without one.",
    "unwritten = true: the command of the scan before did not reach the plant; your loop learns it before this scan. "
    "Somebody may have moved the MV: the next sound read-back is where it stands, also by hand and in a sample that is "
    "refused for another reason. A good sample without any read-back says that there is none: the MV before that "
    "command stays. After a bad read-back there is none to go back to, and nothing is written. A plant of which no "
    "sample has ever had a read-back gets the MV before that command at once.",
    "set_mv: the operator sends the MV there. Your loop refuses it but in MANUAL, after a command that did not arrive, "
    "and outside the range. It goes there by at most max_move a period, at once without one. Where it is not known "
    "where the MV stands, it begins at the scan, from its read-back; without a read-back the MV is where it was sent, "
    "and a bad one ends the way. A way by hand goes on after a command that did not arrive, unless a read-back tells "
    "where the MV stands; another mode ends it.",
    "Before a scan the order is set_mode, set_mv, unwritten, missed. unwritten is about the scan before, whatever has "
    "been set since.",
    "set_mode = SHADOW: others command. Nothing is written (mv = null), and the law is stepped on what is read back. "
    "Once another mode is set, others may have moved the MV since the last sample: the next sound read-back is where "
    "it stands, also in a sample that is refused for another reason, and nothing is written before it. A good sample "
    "without a read-back says that there is none: the MV of the last one stays.",
    "The loop is not told where the MV stands (loop: mv = null). Until a good sample has a read-back, nothing may be "
    "written (mv = null); that read-back is where the loop begins. Only then a fault holds the last MV.",
    "Every number is a hexadecimal float as C's printf writes it with %a and strtod reads it, or nan, inf, -inf.",
)

PASS_OF_OPERATED = (
    "given.operate holds what operators change, in the order of the manifest's operate, and given.fresh is 1 for each "
    "new and good reading, else 0. All scans have the manifest's defaults.",
    "In a scan the bad reading of one PV does not refuse the sample: for ten periods the law is stepped with fresh = 0 "
    "and the PV's last good number, then also with its use = 0. The sample is refused where no controlled variable is "
    "left, where the law has no use of this PV, and where the PV was not read yet.",
)
PASS_OF_AHEAD = (
    "given.ahead holds by how much set points and measured disturbances will differ from given.sp and given.dv: at "
    "each of the horizon's samples one number of each signal, in the order of the manifest's ahead. All scans have "
    "zeros.",
)


def write_kit(controller: Controller, folder: Path) -> dict[str, Any]:
    """Write the kit into ``folder``, which is made if it is not there, and return what ``vectors.json`` holds.

    Beside the controller's file lies the same step for runtimes that want a leading batch of 1, see ``batch_of_one``.

    Raises LoopwrightError if the folder cannot be written.
    """
    batched = batch_of_one(controller.path.read_bytes())
    batched_name = controller.path.with_suffix("").name + BATCH_SUFFIX
    vectors = vectors_of(controller)
    vectors["batch_of_one"] = {"file": batched_name, "sha256": file_digest(batched)}
    try:
        folder.mkdir(parents=True, exist_ok=True)
        copy = folder / controller.path.name
        if not (copy.exists() and copy.samefile(controller.path)):
            shutil.copyfile(controller.path, copy)
        (folder / batched_name).write_bytes(batched)
        copy.with_suffix(".json").write_text(sidecar(controller.manifest, controller.sha256), encoding="utf-8")
        rows = json.dumps(vectors, allow_nan=False).replace('{"part"', '\n{"part"').replace('{"what"', '\n{"what"')
        (folder / VECTORS).write_text(rows + "\n", encoding="utf-8")
    except OSError as error:
        raise LoopwrightError(f"the kit cannot be written to {folder}: {error.strerror or error}") from error
    return vectors


def vectors_of(controller: Controller) -> dict[str, Any]:
    """The content of ``vectors.json``, ready for JSON."""
    m, steps, scans, begin = controller.manifest, answered(controller), scanned(controller), start(controller.manifest)
    scale = entry_scale(controller, steps)
    begins = beginnings(controller, steps, scale, CHAIN_TOLERANCE / KIT_TOLERANCE)
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
        "pass": [
            *PASS,
            *(PASS_OF_OPERATED if {"operate", "fresh"} & set(m.inputs) else ()),
            *(PASS_OF_AHEAD if "ahead" in m.inputs else ()),
        ],
        "tolerance": KIT_TOLERANCE.hex(),
        "chained_tolerance": CHAIN_TOLERANCE.hex(),
        "scale": {name: written(values) for name, values in scale.items()},
        "steps": [_step_row(m.inputs, *pair) for pair in zip(steps, begins, strict=True)],
        "loop": {
            "sp": written(begin.sp),
            "mv": None,
            "recover_after": begin.recover_after,
            "max_gap": begin.max_gap,
            "pv_margin": InRange(m.pv).margin.hex(),
            "read_back_margin": READ_BACK_MARGIN.hex(),
            "max_age_s": m.period_s.hex(),
        },
        "scans": [scan_row(row) for row in scans],
    }


def entry_scale(controller: Controller, answers: list[StepResult]) -> dict[str, Array]:
    """By what each entry's difference is divided: an MV's range, else the entry's largest magnitude in the vectors."""
    taken = [answer.step for answer in answers if answer.step is not None]
    scale = {"mv": np.array([s.high - s.low for s in controller.manifest.mv], dtype=np.float64)}
    for name, rows in (("state_next", [s.state for s in taken]), ("info", [s.info for s in taken])):
        largest = np.abs(rows).max(axis=0)
        scale[name] = np.where(largest > 0, largest, 1.0)
    return scale


def _step_row(inputs: tuple[str, ...], answer: StepResult, begins: bool) -> dict[str, Any]:
    given = answer.given
    row: dict[str, Any] = {"part": given.part, "cold": given.cold, "begins": begins}
    row["given"] = {name: written((given.inputs | {"state": answer.state})[name]) for name in (*inputs, "state")}
    if answer.step is None:
        return row | {"refused": answer.refused}
    mv, state, info = answer.step
    return row | {"gives": {"mv": written(mv), "state_next": written(state), "info": written(info)}}


def scan_row(row: Scanned) -> dict[str, Any]:
    """A scan and this runtime's command as a row of ``scans``."""
    scan, command = row.scan, row.command
    return {
        "what": scan.what,
        "set_mode": None if scan.set_mode is None else str(scan.set_mode),
        "set_mv": None if scan.set_mv is None else written(scan.set_mv),
        "unwritten": scan.unwritten,
        "missed": scan.missed,
        "sample": None if scan.sample is None else _sample_row(scan.sample),
        "mode": str(command.mode),
        "fault": bool(command.fault),
        "mv": written(command.mv) if command.writes else None,
    }


def _sample_row(sample: Sample) -> dict[str, Any]:
    return {
        "pv": written(sample.pv),
        "dv": written(sample.dv),
        "mv_applied": None if sample.mv_applied is None else written(sample.mv_applied),
        "age_s": float(sample.age_s).hex(),
    }


SHOWN_MISTAKES = 5  # mistakes named one by one


@dataclass(slots=True)
class KitDifference:
    """How far a host's numbers are from the kit's, in one kind of run.

    ``largest`` is the largest difference, a share of the entry's scale, and ``where`` its place; ``tolerance`` passes.
    ``same_bits`` counts the rows whose numbers are all equal to the bit, and ``rows`` those that give numbers.
    """

    tolerance: float
    rows: int = 0
    same_bits: int = 0
    largest: float = 0.0
    where: str = ""

    @property
    def passed(self) -> bool:
        """Whether no difference is too large."""
        return self.largest <= self.tolerance

    @property
    def identical(self) -> bool:
        """Whether all rows have the same bits."""
        return self.same_bits == self.rows

    def text(self) -> str:
        """The figure for a person."""
        of = f"{self.largest:.3g} of an entry's scale, allowed {self.tolerance:g}"
        same = f"the same bits in {self.same_bits} of {self.rows}"
        return f"{of}, {same}" + (f": {self.where}" if self.where else "")

    def take(self, where: str, vectors: Iterable[tuple[str, Array, Array, Array]]) -> list[str]:
        """Take one row's ``vectors`` (name, ours, theirs, scale) into account; the mistakes that nothing excuses."""
        mistakes, same = [], True
        for name, ours, theirs, scale in vectors:
            same &= ours.tobytes() == theirs.tobytes()
            if theirs.shape != ours.shape:
                mistakes.append(f"{where}: {name}: {len(theirs)} numbers instead of {len(ours)}")
                continue
            with np.errstate(invalid="ignore"):
                shares = np.abs(theirs - ours) / scale
            for i, share in enumerate(np.where(np.isfinite(shares), shares, inf).tolist()):
                if share > self.largest:
                    self.largest, self.where = share, f"{where}: {name}[{i}]"
        self.rows += 1
        self.same_bits += same
        return mistakes


@dataclass(slots=True)
class KitVerdict:
    """Result of the comparison.

    ``one_step`` compares each step from the state that the kit gives. ``chained`` compares the runs that go on from
    the host's own state, the chained steps and the scans: its largest difference is the sensitivity. ``mistakes`` are
    what no tolerance excuses: a value that should have been refused, another mode.
    """

    host: str
    runtime: str
    one_step: KitDifference
    chained: KitDifference
    mistakes: list[str] = field(default_factory=list)

    @property
    def passed(self) -> bool:
        """Whether the host conforms."""
        return not self.mistakes and self.one_step.passed and self.chained.passed

    @property
    def identical(self) -> bool:
        """Whether the host conforms, and each of its numbers has the same bits."""
        return self.passed and self.one_step.identical and self.chained.identical

    def text(self) -> str:
        """The verdict for a person."""
        lines = [
            f"{self.host}, onnxruntime {self.runtime}: {'passed' if self.passed else 'FAILED'}",
            f"  one step: largest difference {self.one_step.text()}",
            f"  chained: sensitivity {self.chained.text()}",
        ]
        if self.one_step.passed and not self.chained.passed:
            lines.append("  each step is right by itself: look at how the host keeps its state from one to the next")
        lines += [f"  {mistake}" for mistake in self.mistakes[:SHOWN_MISTAKES]]
        if len(self.mistakes) > SHOWN_MISTAKES:
            lines.append(f"  and {len(self.mistakes) - SHOWN_MISTAKES} more")
        return "\n".join(map(plain, lines))  # the answers' file holds any text


def check(folder: Path, answers: Path, sha256: str) -> KitVerdict:
    """Compare a host's ``answers`` with the kit in ``folder``, which is of the controller file with this ``sha256``.

    Raises LoopwrightError if either cannot be read, or the answers are those of another controller.
    """
    kit, theirs = _json(folder / VECTORS, "the kit"), _json(answers, "the answers")
    if kit.get("kit") != KIT:
        raise LoopwrightError(
            f"{folder / VECTORS} has the version {kit.get('kit')}; this release reads {KIT}: "
            "write it again with loopwright conformance FILE OUT, and let the host answer that one"
        )
    for path, found in ((folder / VECTORS, kit.get("sha256")), (answers, theirs.get("sha256"))):
        if found != sha256:
            raise LoopwrightError(f"{path} is for the controller with the SHA-256 {found}; this file's is {sha256}")
    one_step, chained = (KitDifference(float.fromhex(kit[name])) for name in ("tolerance", "chained_tolerance"))
    host, runtime = str(theirs.get("host", "a host")), str(theirs.get("onnxruntime", "unknown"))
    verdict = KitVerdict(host, runtime, one_step, chained)
    scale = read_all(kit["scale"], "scale")
    for name, word, run in (("steps", "step", verdict.one_step), ("chained", "chained step", verdict.chained)):
        for k, (row, answer) in enumerate(_pairs(kit["steps"], theirs, name, verdict)):
            verdict.mistakes += _step_mistakes(run, f"{word} {k} ({row['part']})", row, answer, scale)
    for k, (row, answer) in enumerate(_pairs(kit["scans"], theirs, "scans", verdict)):
        verdict.mistakes += _scan_mistakes(verdict.chained, f"scan {k} ({row['what']})", row, answer, scale["mv"])
    return verdict


def _pairs(rows: list[Any], theirs: Mapping[str, Any], name: str, verdict: KitVerdict) -> list[tuple[Any, Any]]:
    answers = theirs.get(name)
    if not isinstance(answers, list) or not all(isinstance(answer, dict) for answer in answers):
        raise ContractError(f"the answers have no list of objects {name!r}")
    if len(answers) != len(rows):
        verdict.mistakes.append(f"{name}: {len(answers)} are answered instead of {len(rows)}")
    return list(zip(rows, answers, strict=False))


def _step_mistakes(
    run: KitDifference, where: str, row: Mapping[str, Any], answer: Mapping[str, Any], scale: Mapping[str, Array]
) -> list[str]:
    wanted, refused = row.get("refused", ""), answer.get("refused", "")
    if wanted != refused:
        return [f"{where}: {_refused(refused)}, but must be {_refused(wanted)}"]
    if wanted:
        return []
    vectors = [
        (name, read(row["gives"][name], where), read(answer.get(name), f"{where}: {name}"), scale[name])
        for name in OUTPUTS
    ]
    return run.take(where, vectors)


def _scan_mistakes(
    run: KitDifference, where: str, row: Mapping[str, Any], answer: Mapping[str, Any], scale: Array
) -> list[str]:
    mistakes = [
        f"{where}: {name} is {answer.get(name)!r}, but must be {row[name]!r}"
        for name in ("mode", "fault")
        if answer.get(name) != row[name]
    ]
    wanted, found = row["mv"], answer.get("mv")
    if wanted is None and found is not None:
        mistakes.append(f"{where}: an MV is written, but where it stands is not known yet: mv must be null")
    elif wanted is not None and found is None:
        mistakes.append(f"{where}: no MV is written, but one must be")
    elif wanted is not None:
        mistakes += run.take(where, [("mv", read(wanted, where), read(found, f"{where}: mv"), scale)])
    return mistakes


def _refused(reason: str) -> str:
    return f"refused because of the {reason}" if reason else "computed"


def _json(path: Path, what: str) -> dict[str, Any]:
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or error
        raise LoopwrightError(f"{what} cannot be read from {path}: {reason}") from error
    if not isinstance(content, dict):
        raise LoopwrightError(f"{what} in {path} is no JSON object")
    return content
