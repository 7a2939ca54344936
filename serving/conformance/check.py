"""The answers of a host compared with the kit's."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from math import inf
from pathlib import Path
from typing import Any

import numpy as np

from loopwright.serving.conformance.kit import KIT, VECTORS, Array, read, read_all
from loopwright.serving.errors import ContractError, LoopwrightError
from loopwright.serving.words import plain

OUTPUTS = ("mv", "state_next", "info")
READS = (1, 2, KIT)  # versions of the kit
MOVED = "writes nothing over an MV that was moved after a command that did not arrive"
UNSHOWN = {1: f"writes nothing before it knows the plant, and that it {MOVED}", 2: MOVED}  # by older kits
SHOWN = 5  # mistakes named one by one


@dataclass(slots=True)
class Verdict:
    """Result of the comparison.

    ``largest`` is the largest difference, a share of the entry's scale, and ``where`` its place. ``same_bits`` counts
    the steps whose numbers are all equal to the bit, and ``steps`` those that give numbers. ``mistakes`` are what no
    tolerance excuses: a value that should have been refused, another mode. ``note`` says what the kit does not show.
    """

    host: str
    runtime: str
    tolerance: float
    steps: int = 0
    same_bits: int = 0
    largest: float = 0.0
    where: str = ""
    mistakes: list[str] = field(default_factory=list)
    note: str = ""

    @property
    def passed(self) -> bool:
        """Whether the host conforms."""
        return not self.mistakes and self.largest <= self.tolerance

    def text(self) -> str:
        """The verdict for a person."""
        lines = [
            f"{self.host}, onnxruntime {self.runtime}: {'passed' if self.passed else 'FAILED'}",
            f"  same bits in {self.same_bits} of {self.steps} steps",
            f"  largest difference {self.largest:.3g} of an entry's scale, allowed {self.tolerance:g}"
            + (f": {self.where}" if self.where else ""),
        ]
        lines += [f"  {mistake}" for mistake in self.mistakes[:SHOWN]]
        if len(self.mistakes) > SHOWN:
            lines.append(f"  and {len(self.mistakes) - SHOWN} more")
        if self.note:
            lines.append(f"  {self.note}")
        return "\n".join(map(plain, lines))  # the answers' file holds any text

    def compare(self, where: str, ours: Array, theirs: Array, scale: Array) -> bool:
        """Take the difference of one vector into account; whether all bits are equal."""
        if theirs.shape != ours.shape:
            self.mistakes.append(f"{where}: {len(theirs)} numbers instead of {len(ours)}")
            return False
        if not ours.size:
            return True
        with np.errstate(invalid="ignore"):
            shares = np.abs(theirs - ours) / scale
        shares[~np.isfinite(shares)] = inf
        worst = int(shares.argmax())
        if shares[worst] > self.largest:
            self.largest, self.where = float(shares[worst]), f"{where}[{worst}]"
        return ours.tobytes() == theirs.tobytes()


def check(folder: Path, answers: Path, sha256: str) -> Verdict:
    """Compare a host's ``answers`` with the kit in ``folder``, which is of the controller file with this ``sha256``.

    Raises LoopwrightError if either cannot be read, or the answers are those of another controller.
    """
    kit, theirs = _json(folder / VECTORS, "the kit"), _json(answers, "the answers")
    if kit.get("kit") not in READS:
        raise LoopwrightError(
            f"{folder / VECTORS} has the version {kit.get('kit')}; this release reads {', '.join(map(str, READS))}: "
            "write it again with loopwright conformance FILE OUT"
        )
    for path, found in ((folder / VECTORS, kit.get("sha256")), (answers, theirs.get("sha256"))):
        if found != sha256:
            raise LoopwrightError(f"{path} is for the controller with the SHA-256 {found}; this file's is {sha256}")
    tolerance = float.fromhex(kit["tolerance"])
    verdict = Verdict(str(theirs.get("host", "a host")), str(theirs.get("onnxruntime", "unknown")), tolerance)
    if kit["kit"] in UNSHOWN:
        verdict.note = (
            f"the kit has the version {kit['kit']}: it does not show that the host {UNSHOWN[kit['kit']]}; "
            "write it again with loopwright conformance FILE OUT"
        )
    scale = read_all(kit["scale"], "scale")
    for k, (row, answer) in enumerate(_pairs(kit, theirs, "steps", verdict)):
        _check_step(verdict, f"step {k} ({row['part']})", row, answer, scale)
    for k, (row, answer) in enumerate(_pairs(kit, theirs, "scans", verdict)):
        _check_scan(verdict, f"scan {k} ({row['what']})", row, answer, scale["mv"])
    return verdict


def _pairs(kit: Mapping[str, Any], theirs: Mapping[str, Any], name: str, verdict: Verdict) -> list[tuple[Any, Any]]:
    rows, answers = kit[name], theirs.get(name)
    if not isinstance(answers, list) or not all(isinstance(answer, dict) for answer in answers):
        raise ContractError(f"the answers have no list of objects {name!r}")
    if len(answers) != len(rows):
        verdict.mistakes.append(f"{len(answers)} {name} are answered instead of {len(rows)}")
    return list(zip(rows, answers, strict=False))


def _check_step(v: Verdict, where: str, row: Mapping[str, Any], answer: Mapping[str, Any], scale: Any) -> None:
    wanted, refused = row.get("refused", ""), answer.get("refused", "")
    if wanted or refused:
        if wanted != refused:
            v.mistakes.append(f"{where}: {_refused(refused)}, but must be {_refused(wanted)}")
        return
    v.steps += 1
    same = [
        v.compare(
            f"{where}: {name}", read(row["gives"][name], where), read(answer.get(name), f"{where}: {name}"), scale[name]
        )
        for name in OUTPUTS
    ]
    v.same_bits += all(same)


def _check_scan(v: Verdict, where: str, row: Mapping[str, Any], answer: Mapping[str, Any], scale: Array) -> None:
    for name in ("mode", "fault"):
        if answer.get(name) != row[name]:
            v.mistakes.append(f"{where}: {name} is {answer.get(name)!r}, but must be {row[name]!r}")
    wanted, found = row["mv"], answer.get("mv")
    if wanted is None and found is not None:
        v.mistakes.append(f"{where}: an MV is written, but where it stands is not known yet: mv must be null")
    elif wanted is not None and found is None:
        v.mistakes.append(f"{where}: no MV is written, but one must be")
    elif wanted is not None:
        v.compare(f"{where}: mv", read(wanted, where), read(found, f"{where}: mv"), scale)


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
