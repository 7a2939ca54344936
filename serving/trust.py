"""The Controller of a host: loaded from a file, and if wanted only from one that a trusted key signed.

Apart from ``loopwright.serving.controller``, because what steps a controller decides results of the pipeline's stages,
and who signed its file decides none of them.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum
from math import isfinite
from os import PathLike
from typing import TYPE_CHECKING, Any

from loopwright.serving import controller
from loopwright.serving.errors import ArtifactError, NotProvenError
from loopwright.serving.in_charge.adapted import AdaptedController
from loopwright.serving.manifest import Manifest

if TYPE_CHECKING:
    from loopwright.serving.signing.verify import Signed, Trusted


class Controller(controller.Controller):
    """A control law in one file: ``(sp, pv, dv, mv_applied, state) -> (mv, state_next, info)``.

    Parameters
    ----------
    path
        The .onnx file that the pipeline exported.
    sha256
        The file's own SHA-256, if the host wants this very file and no other. The digest inside
        the file finds damage and careless edits; only a pinned digest or a signature finds a forged file.
    trusted
        Public keys (PEM files), if the host wants only files that one of them signed. The signature lies beside the
        file, ``<path>.sig``. It is verified before anything else of the file is read. None: nobody is asked.

    Raises
    ------
    SignatureError
        The file is unsigned, signed by none of ``trusted``, or changed since; or its signature expired.
    ArtifactError
        The file is corrupt, truncated, foreign or changed, holds what a controller may not
        (see ``loopwright.serving.graph.audit``), or its manifest and its graph disagree.

    Notes
    -----
    ``signed`` says who signed the file; None where nobody was asked.
    A step holds a lock, because its buffers are bound to the session once and used by every step.
    """

    def __init__(self, path: str | PathLike[str], sha256: str | None = None, trusted: Trusted | None = None) -> None:
        self.signed: Signed | None = None
        if trusted is not None:
            from loopwright.serving.signing.verify import verified  # here: it needs the package cryptography

            self.signed = verified(path, trusted)
            if sha256 is not None and sha256.lower() != self.signed.sha256:
                raise ArtifactError(
                    f"{path}: the file's SHA-256 is {self.signed.sha256}, not the pinned {sha256}; "
                    "pin this one only if you changed the file yourself"
                )
            # The signature gives the pin: bytes that somebody puts there meanwhile are not those that were verified.
            sha256 = self.signed.sha256
        super().__init__(path, sha256)


def signer(loaded: controller.Controller) -> Signed | None:
    """Signer of a controller's file; None where nobody was asked."""
    if isinstance(loaded, AdaptedController):
        loaded = loaded.inner
    return loaded.signed if isinstance(loaded, Controller) else None


def ending(loaded: controller.Controller) -> list[str]:
    """A line for a person where the signature of a controller's file ends soon, or has ended."""
    signed = signer(loaded)
    words = "" if signed is None else signed.ending()
    return [words] if words else []


class Proof(Enum):
    """The verdict on the evidence of a file."""

    PROVEN = "proven"
    NONE = "no evidence"  # straight out of `design`, or of another maker
    LOCKED_UP = "locked up"
    MODEL = "model not proven"  # its tests ran on models that the plant's record does not prove


@dataclass(frozen=True, slots=True)
class TrustVerdict:
    """The judgement, and why in words; ``why`` is empty for a controller that is proven."""

    proof: Proof
    why: str = ""

    @property
    def words(self) -> str:
        """To go on a sentence: ``not proven: ...``; empty for a controller that is proven."""
        return f"not proven: {self.why}" if self.why else ""


def judged(manifest: Manifest) -> TrustVerdict:
    """The verdict on a controller.

    Proven is one whose file holds figures of closed loops, and says that none locked up; where they ran on models of a
    plant's record, nothing may speak against these models. Figures that missed a requirement are the report's matter.
    """
    evidence: dict[str, Any] = manifest.evidence
    lock_ups, grounds = evidence.get("lock_ups"), evidence.get("on")
    counted = type(lock_ups) is int and lock_ups >= 0
    if not (counted and (lock_ups or _has_figures(evidence.get("scenarios")))):
        return TrustVerdict(Proof.NONE, "its file holds no evidence of closed loops")
    if lock_ups:
        return TrustVerdict(Proof.LOCKED_UP, f"it locked up in {lock_ups} closed loop{'s' if lock_ups > 1 else ''}")
    unproven = grounds.get("unproven") if isinstance(grounds, dict) else None
    if unproven:
        reasons = unproven if isinstance(unproven, list) else [unproven]
        return TrustVerdict(Proof.MODEL, "; ".join(str(reason).removeprefix("not proven: ") for reason in reasons))
    return TrustVerdict(Proof.PROVEN)


def _has_figures(scenarios: Any) -> bool:
    """Whether a closed loop has a figure at all."""
    rows = scenarios.values() if isinstance(scenarios, dict) else ()
    figures = [figure for row in rows if isinstance(row, dict) for figure in row.values()]
    return any(type(figure) in (int, float) and isfinite(figure) for figure in figures)


def require_accepted(manifest: Manifest, accepted: bool) -> TrustVerdict:
    """The verdict on a controller that is to write in AUTO. NotProvenError where it is not, and nobody accepts it."""
    verdict = judged(manifest)
    if verdict.why and not accepted:
        words = (
            f"{manifest.law} is {verdict.words}; AUTO needs your word for it: accept_unproven = true in loop.toml, or "
            "--accept-unproven at `loopwright loop mode` and `loop swap`"
        )
        raise NotProvenError(words, f"{manifest.law}: {verdict.why}")
    return verdict
