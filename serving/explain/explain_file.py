"""The file of an explain graph: its own manifest, which names the controller that it belongs to."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self, get_args

from loopwright.serving.controller_file import DIGEST_KEY, EXPLAIN_SUFFIX
from loopwright.serving.errors import ArtifactError
from loopwright.serving.explain.explanation import Cause
from loopwright.serving.manifest import INPUTS, Manifest, strictly

EXPLAIN_KEY = "loopwright.explain"
EXPLAIN_SCHEMA = 1  # of the explain manifest: a runtime refuses another
CAUSES = frozenset(get_args(Cause))
MOST_PARTS = 10_000  # of a move


def explain_path(controller: str | Path) -> Path:
    """Where the explain graph of a controller's file lies: ``predictive.explain.onnx`` beside ``predictive.onnx``."""
    path = Path(controller)
    return path.with_name(path.name.removesuffix(".onnx") + EXPLAIN_SUFFIX)


def controller_path(explain: str | Path) -> Path:
    """The controller's file that lies beside an explain graph."""
    path = Path(explain)
    return path.with_name(path.name.removesuffix(EXPLAIN_SUFFIX) + ".onnx")


@dataclass(frozen=True, slots=True)
class ExplainManifest:
    """What an explain graph says of itself.

    It belongs to the file with the SHA-256 ``controller``, has these ``inputs`` of that one, and predicts the first
    ``outputs`` process variables over ``horizon`` samples. The MVs' moves start at the samples ``starts``. ``parts``
    are the cause and the signal of each part of a move, in the graph's order.
    """

    controller: str
    inputs: tuple[str, ...]
    outputs: int
    horizon: int
    starts: tuple[int, ...]
    parts: tuple[tuple[str, str], ...]
    schema: int = EXPLAIN_SCHEMA

    def __post_init__(self) -> None:
        if self.schema != EXPLAIN_SCHEMA:
            raise ArtifactError(
                f"the explain manifest has schema {self.schema}; this runtime reads {EXPLAIN_SCHEMA}: design the "
                "controller again or use the matching release of loopwright"
            )
        if any(name not in INPUTS for name in self.inputs):
            raise ArtifactError(
                f"the explain manifest's inputs are {list(self.inputs)}; allowed are {', '.join(INPUTS)}"
            )
        strange = sorted({cause for cause, _ in self.parts} - CAUSES)
        if strange or not 1 <= len(self.parts) <= MOST_PARTS:
            raise ArtifactError(f"the explain manifest has {strange[0] if strange else len(self.parts)!r} as parts")
        if self.outputs < 1 or self.horizon < 1 or not self.starts or sorted(set(self.starts)) != [*self.starts]:
            raise ArtifactError(
                "the explain manifest has no outputs, no horizon, or moves that do not follow each other"
            )

    def to_json(self) -> str:
        """The manifest as JSON."""
        names = ("schema", "controller", "inputs", "outputs", "horizon", "starts", "parts")
        return json.dumps({name: getattr(self, name) for name in names})

    @classmethod
    def from_json(cls, text: str) -> Self:
        """The manifest in ``text``; ArtifactError where it is none."""
        row = strictly(text)
        try:
            return cls(
                controller=str(row["controller"]),
                inputs=tuple(map(str, row["inputs"])),
                outputs=int(row["outputs"]),
                horizon=int(row["horizon"]),
                starts=tuple(map(int, row["starts"])),
                parts=tuple((str(cause), str(signal)) for cause, signal in row["parts"]),
                schema=int(row["schema"]),
            )
        except (KeyError, TypeError, ValueError) as error:
            raise ArtifactError(f"the explain manifest is malformed: {type(error).__name__} {error}") from error

    def sizes(self, manifest: Manifest) -> tuple[dict[str, int], dict[str, int]]:
        """Length of each input and of each output of the graph, of a controller with this manifest."""
        sizes, n_mv = manifest.sizes(), len(manifest.mv)
        outputs = {
            "mv": n_mv,
            "state_next": manifest.n_state,
            "y": self.horizon * self.outputs,
            "z": len(self.starts) * n_mv,
            "move": n_mv,
            "parts": len(self.parts) * n_mv,
            "news": len(manifest.dv) + self.outputs,
        }
        return {name: sizes[name] for name in self.inputs}, outputs


def explain_manifest(metadata: dict[str, Any]) -> ExplainManifest:
    """The manifest among a file's metadata; ArtifactError where the file explains nothing."""
    if EXPLAIN_KEY not in metadata:
        raise ArtifactError(f"the file has no {EXPLAIN_KEY}: it explains no controller")
    strange = sorted(set(metadata) - {EXPLAIN_KEY, DIGEST_KEY})
    if strange:  # onnxruntime takes settings from some entries
        raise ArtifactError(f"the file has the metadata entry {strange[0]!r}, which no explain graph has")
    return ExplainManifest.from_json(metadata[EXPLAIN_KEY])
