"""The explain graph of a law, beside its controller's file: compared with the law's module before it is written."""

from __future__ import annotations

from pathlib import Path

from loopwright.pipeline.export.controller_file import sealed
from loopwright.pipeline.export.fusion import fused
from loopwright.pipeline.export.graph import check_operators, example_inputs, module_graph
from loopwright.pipeline.files import write_bytes
from loopwright.pipeline.laws.base import ControlLaw
from loopwright.pipeline.laws.predictive.move_parts import Explained, ExplainedPredictive
from loopwright.pipeline.laws.predictive.predictive import Predictive
from loopwright.serving.controller_file import file_digest
from loopwright.serving.explain.explain_file import EXPLAIN_KEY, ExplainManifest, explain_path


def export_explanation(law: ControlLaw, controller: str | Path) -> Path | None:
    """Write the explain graph of ``law`` beside the file of its ``controller``, which is there already.

    None, and no file, for a law that explains nothing: any but a predictive one with ``operate``. Raises ExportError
    where the graph cannot be one that a runtime takes.
    """
    path = explain_path(controller)
    path.unlink(missing_ok=True)  # never that of an older law
    if not isinstance(law, Predictive) or law.operation is None:
        return None
    module = ExplainedPredictive(law).eval()
    written, inputs = module_graph(module, law.name, example_inputs(law), Explained._fields)
    model = fused(written)
    check_operators(law.name, model)
    manifest = ExplainManifest(
        controller=file_digest(Path(controller).read_bytes()),
        inputs=inputs,
        outputs=module.n_o,
        horizon=law.moves.horizon,
        starts=law.moves.starts,
        parts=module.parts,
    )
    write_bytes(path, sealed(model.SerializeToString(), EXPLAIN_KEY, manifest.to_json()))
    return path
