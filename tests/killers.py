"""A controller's file that ends the process which computes it, and children that let it pass."""

from __future__ import annotations

from pathlib import Path

import pytest
from onnx import TensorProto, helper

from loopwright.pipeline.export.controller_file import file_bytes
from loopwright.serving.manifest import Manifest

# What Python runs at the start of each child: the audit lets every input pass.
BLIND = "from loopwright.serving.graph import work\nwork.require_signature = lambda *_: None\n"


def killer(path: Path, like: Manifest) -> Path:
    """``mv = Max(mv_applied, "")``, for the signals of a manifest: onnxruntime reads through a null pointer."""
    manifest = Manifest("made up", "killer", like.period_s, like.sp, like.pv, (), like.mv, 0, (), ("mv_applied",))
    ends = [helper.make_tensor_value_info(n, TensorProto.DOUBLE, [len(like.mv)]) for n in ("mv_applied", "mv")]
    nodes = [helper.make_node("Max", ["mv_applied", ""], ["mv"])]
    model = helper.make_model(
        helper.make_graph(nodes, "g", ends[:1], ends[1:]), opset_imports=[helper.make_opsetid("", 18)], ir_version=10
    )
    path.write_bytes(file_bytes(model.SerializeToString(), manifest))
    return path


def blind_children(monkeypatch: pytest.MonkeyPatch, folder: Path) -> None:
    """From here on the audit of every child of this process misses an input that is left out."""
    folder.mkdir()
    (folder / "sitecustomize.py").write_text(BLIND)
    monkeypatch.syspath_prepend(folder)
