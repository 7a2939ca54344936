"""The graph with a leading batch of 1 gives the bits of the controller, on every shipped file."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import onnx
import onnxruntime
import pytest
from kits import kit_of, name
from numpy.typing import NDArray
from shipped_files import SHIPPED

from loopwright.serving import ArtifactError, Controller
from loopwright.serving.conformance.batch_of_one import batch_of_one
from loopwright.serving.conformance.steps import OUTPUTS, answered
from loopwright.serving.controller_file import BATCH_SUFFIX, unseal
from loopwright.serving.graph.onnx_bytes import read_model, write_model

pytest_plugins = ["operated_laws", "course_files"]
STEPS = 60


def session_on(data: bytes) -> onnxruntime.InferenceSession:
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = 1
    return onnxruntime.InferenceSession(data, options, providers=["CPUExecutionProvider"])


def differing(file: Path, steps: int) -> list[int]:
    """The steps of the kit, spread over it, in which a bit differs; each from the state that the kit gives."""
    controller = Controller(file)
    net = session_on(batch_of_one(file.read_bytes()))
    rows = [row for row in answered(controller) if row.step is not None]
    found = []
    for k in sorted({int(k) for k in np.linspace(0, len(rows) - 1, steps)}):
        step = rows[k].step
        assert step is not None
        given = {**rows[k].given.inputs, "state": rows[k].state}
        feed = {i.name: given[i.name].reshape(1, -1) for i in net.get_inputs()}
        results: list[NDArray[np.float64]] = net.run(None, feed)
        got = dict(zip((o.name for o in net.get_outputs()), results, strict=True))
        for wanted, numbers in zip(OUTPUTS, step, strict=True):
            if numbers.size and (got[wanted].shape != (1, numbers.size) or got[wanted].tobytes() != numbers.tobytes()):
                found.append(k)
    return found


@pytest.mark.parametrize("file", SHIPPED, ids=name)
def test_the_bits_are_the_controllers(file: Path) -> None:
    assert differing(file, STEPS) == []


def test_laws_that_operators_steer_and_that_know_what_is_to_come(operated_file: Path, course_file: Path) -> None:
    for file, read in ((operated_file, "operate"), (operated_file, "fresh"), (course_file, "ahead")):
        assert read in Controller(file).manifest.inputs
        assert differing(file, STEPS) == []


def test_the_graph_is_sound_by_onnx_too() -> None:
    data = batch_of_one(SHIPPED[0].read_bytes())
    model = onnx.load_from_string(data)
    onnx.checker.check_model(model, full_check=True)
    m = Controller(SHIPPED[0]).manifest
    shapes = {v.name: [d.dim_value for d in v.type.tensor_type.shape.dim] for v in (*model.graph.input,)}
    assert list(shapes) == list(m.inputs)
    assert shapes["pv"] == [1, len(m.pv)]


def test_bytes_are_written_as_they_are_read() -> None:
    for file in SHIPPED:
        body = unseal(file.read_bytes())
        assert write_model(read_model(body)) == body


def test_the_kit_has_it_and_the_runtime_refuses_it(tmp_path: Path) -> None:
    folder = kit_of(SHIPPED[0])
    data = (folder / (SHIPPED[0].stem + BATCH_SUFFIX)).read_bytes()
    assert data == batch_of_one(SHIPPED[0].read_bytes())
    copy = tmp_path / "law.onnx"
    copy.write_bytes(data)
    with pytest.raises(ArtifactError):
        Controller(copy)
    with pytest.raises(ArtifactError):
        batch_of_one(data[:-1])
