"""A controller file either is what was exported or is refused; a step gives numbers or an error."""

from __future__ import annotations

import contextlib
import json
import math
import os
import resource
import signal
import socket
import subprocess
import sys
import threading
import traceback
from collections import deque
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import onnxruntime as ort
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from onnx import TensorProto, helper, numpy_helper

from loopwright.pipeline.laws import ControlLaw
from loopwright.serving import ArtifactError, ContractError, Controller, Manifest, SampleError, Signal
from loopwright.serving import controller as controller_module
from loopwright.serving.controller_file import TRAILER_BYTES, seal
from loopwright.serving.errors import OutputError
from loopwright.serving.graph.audit import audit
from loopwright.serving.manifest import MANIFEST_KEY
from loopwright.serving.vectorized_controller import VectorizedController

pytest_plugins = ["small_laws"]
FEED: dict[str, Any] = {"sp": 1.0, "pv": [0.8, 300.0], "mv_applied": [40.0], "state": [1.0, 0.1]}


def write(path: Path, data: bytes) -> Path:
    path.write_bytes(data)
    return path


def sealed(path: Path, model: onnx.ModelProto, manifest: Manifest | str | None) -> Path:
    """A file with a valid digest, whatever it holds."""
    copy = onnx.ModelProto.FromString(model.SerializeToString())
    del copy.metadata_props[:]
    if manifest is not None:
        text = manifest if isinstance(manifest, str) else manifest.to_json()
        copy.metadata_props.append(onnx.StringStringEntryProto(key=MANIFEST_KEY, value=text))
    return write(path, seal(copy.SerializeToString()))


def edited(controller: Controller, **changed: Any) -> str:
    return json.dumps({**json.loads(controller.manifest.to_json()), **changed})


# ---------------------------------------------------------------------- stepping
def test_step_equals_the_law(controller: Controller, pi_law: ControlLaw) -> None:
    rng, state = np.random.default_rng(0), controller.cold_state()
    for _ in range(100):
        sp, pv, mv = rng.uniform(0, 2, 1), rng.uniform([0, 250], [2, 400]), rng.uniform(0, 100, 1)
        expected = pi_law(*(torch.from_numpy(v) for v in (sp, pv, np.zeros(1), mv, state)))
        step = controller.step(sp=sp, pv=pv, mv_applied=mv, state=state, dv=[0.0])
        for ours, theirs in zip(step, expected, strict=True):
            np.testing.assert_allclose(ours, theirs.numpy(), rtol=1e-14, atol=1e-14)
        state = step.state


@pytest.mark.parametrize(
    "pv",
    [[0.8, 300], (0.8, 300), np.array([0.8, 300.0]), np.array([9, 0.8, 9, 300.0])[1::2], np.array([0.8, 300], ">f8")],
)
def test_any_vector_of_numbers_will_do(controller: Controller, pv: Any) -> None:
    reference = controller.step(**FEED)
    for sp in (1.0, 1, [1], np.float32(1), np.array([1])):
        step = controller.step(**{**FEED, "sp": sp, "pv": pv})
        assert all(np.array_equal(a, b) for a, b in zip(step, reference, strict=True))


def test_results_do_not_share_memory_with_the_next_step(controller: Controller) -> None:
    first = controller.step(**FEED)
    kept = [part.copy() for part in first]
    controller.step(**{**FEED, "sp": 1.7})
    assert all(np.array_equal(a, b) for a, b in zip(first, kept, strict=True))


def test_warming_changes_nothing(controller: Controller) -> None:
    controller.warm()
    reference = controller.step(**FEED)
    with pytest.raises(SampleError):
        controller.step(**{**FEED, "sp": math.nan})
    controller.warm()
    assert all(np.array_equal(a, b) for a, b in zip(controller.step(**FEED), reference, strict=True))


def test_threads_do_not_mix_their_steps(controller: Controller) -> None:
    wrong: list[float] = []

    def work(sp: float) -> None:
        expected = controller.step(**{**FEED, "sp": sp}).info[0]
        wrong.extend(sp for _ in range(300) if controller.step(**{**FEED, "sp": sp}).info[0] != expected)

    threads = [threading.Thread(target=work, args=(0.1 + 0.4 * i,)) for i in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert not wrong


@pytest.mark.skipif(not hasattr(os, "fork"), reason="processes fork on POSIX only")
@pytest.mark.filterwarnings("ignore:This process .* is multi-threaded")
@pytest.mark.parametrize("ends", [True, False], ids=["a step that ends", "a step that is too slow"])
def test_a_forked_child_does_not_wait_for_a_step_of_another_thread(
    controller: Controller, monkeypatch: pytest.MonkeyPatch, ends: bool
) -> None:
    """The thread that steps is none of the child's: it would never release the lock there."""
    monkeypatch.setattr(controller_module, "LONGEST_STEP_S", 60.0 if ends else 0.0)
    stepping, forking = threading.Event(), threading.Event()

    def step() -> None:
        with controller._lock:
            stepping.set()
            if ends:
                while not controller_module._forking.locked():
                    pass
            else:
                forking.wait()

    thread = threading.Thread(target=step)
    thread.start()
    stepping.wait()
    child = os.fork()
    if child == 0:
        signal.alarm(20)
        os._exit(0 if controller.step(**FEED).mv.size else 1)
    forking.set()
    thread.join()
    assert os.waitpid(child, 0)[1] == 0
    assert not controller._lock.locked()
    assert not controller_module._forking.locked()
    controller.step(**FEED)


# ---------------------------------------------------------------------- wrong inputs
@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"pv": [0.8]}, r"pv has the shape \(1,\); it needs shape \(2,\): level \[m\], T \[K\]"),
        ({"pv": 0.8}, r"pv has the shape \(\)"),
        ({"pv": [[0.8, 300.0]]}, r"pv has the shape \(1, 2\)"),
        ({"sp": [1.0, 2.0]}, r"sp has the shape \(2,\)"),
        ({"sp": "1.0"}, "sp has the type <U3; it needs numbers"),
        ({"sp": True}, "sp has the type bool"),
        ({"pv": [True, 300.0]}, "pv has the type bool in part"),
        ({"pv": (1.0, np.bool_(1))}, "pv has the type bool in part"),
        ({"pv": [np.array(True), 300.0]}, "pv has the type bool in part"),
        ({"sp": [True]}, "sp has the type bool"),
        ({"mv_applied": deque([False])}, "mv_applied has the type bool"),
        ({"sp": 1 + 0j}, "sp has the type complex128"),
        ({"sp": None}, "sp is missing"),
        ({"sp": [[1.0], [1.0, 2.0]]}, "sp is no vector of numbers"),
        ({"state": [0.0]}, r"state has the shape \(1,\); it needs shape \(2,\), from the last step or cold_state"),
        ({"mv_applied": np.zeros(3)}, r"mv_applied has the shape \(3,\); it needs shape \(1,\): valve \[%\]"),
    ],
)
def test_wrong_shape_or_type_is_named(controller: Controller, changed: dict[str, Any], message: str) -> None:
    with pytest.raises(ContractError, match=message) as caught:
        controller.step(**{**FEED, **changed})
    assert "\n" not in str(caught.value)


def test_wrong_name_is_pythons_own_error(controller: Controller) -> None:
    with pytest.raises(TypeError, match="setpoint"):
        controller.step(**{**FEED, "setpoint": 1.0})


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
@pytest.mark.parametrize(("name", "place"), [("sp", 0), ("pv", 1), ("mv_applied", 0), ("state", 1)])
def test_a_value_that_is_not_finite_gives_no_mv(controller: Controller, name: str, place: int, value: float) -> None:
    vector = np.atleast_1d(np.array(FEED[name], dtype=float))
    vector[place] = value
    with pytest.raises(SampleError, match=f"{name}: .* is {value}"):
        controller.step(**{**FEED, name: vector})


@settings(deadline=None)
@given(st.lists(st.floats(allow_nan=True, allow_infinity=True, width=64), min_size=6, max_size=6))
def test_whatever_comes_in_the_mv_is_in_range_or_there_is_none(
    controller_once: Controller, values: list[float]
) -> None:
    c = controller_once
    try:
        step = c.step(sp=values[0], pv=values[1:3], mv_applied=values[3], state=values[4:])
    except (SampleError, OutputError):
        return
    assert np.isfinite(values).all()
    assert 0 <= step.mv[0] <= 100


@pytest.fixture(scope="module")
def controller_once(pi_file: Path) -> Controller:
    return Controller(pi_file)


def test_huge_finite_values_are_not_taken_for_infinite(controller: Controller) -> None:
    step = controller.step(sp=0.0, pv=[0.0, 300.0], mv_applied=1e308, state=[1e308, 1.0])
    assert step.mv.tolist() == [100.0]


# ---------------------------------------------------------------------- wrong files
def test_every_changed_byte_is_noticed(pi_file: Path, tmp_path: Path) -> None:
    data = bytearray(pi_file.read_bytes())
    for at in [*range(0, len(data), 7), *range(len(data) - TRAILER_BYTES, len(data))]:
        data[at] ^= 0x10
        with pytest.raises(ArtifactError):
            Controller(write(tmp_path / "x.onnx", bytes(data)))
        data[at] ^= 0x10
    Controller(write(tmp_path / "x.onnx", bytes(data)))


def test_every_truncation_is_noticed(pi_file: Path, tmp_path: Path) -> None:
    data = pi_file.read_bytes()
    for length in [*range(0, len(data), 101), len(data) - 1, len(data) - TRAILER_BYTES]:
        with pytest.raises(ArtifactError, match=r"truncated|changed"):
            Controller(write(tmp_path / "x.onnx", data[:length]))
    with pytest.raises(ArtifactError, match="truncated"):
        Controller(write(tmp_path / "x.onnx", data + b"\0"))


@settings(deadline=None)
@given(st.binary(max_size=300))
def test_any_bytes_are_an_error_or_an_onnx_file(data: bytes) -> None:
    try:
        audit(data)
    except ArtifactError:
        return
    onnx.ModelProto.FromString(data)


@settings(deadline=None)
@given(at=st.integers(0, 10**9), bit=st.integers(0, 7))
def test_a_forged_digest_over_a_changed_graph_gives_no_other_error(
    pi_bytes: bytes, forged: Path, at: int, bit: int
) -> None:
    data = bytearray(pi_bytes)
    data[at % len(data)] ^= 1 << bit
    forged.write_bytes(seal(bytes(data)))
    with contextlib.suppress(ArtifactError):
        Controller(forged)


@pytest.fixture(scope="module")
def pi_bytes(pi_file: Path) -> bytes:
    return pi_file.read_bytes()[:-TRAILER_BYTES]


@pytest.fixture(scope="module")
def forged(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("forged") / "x.onnx"


def test_a_missing_file_and_a_folder(tmp_path: Path) -> None:
    with pytest.raises(ArtifactError, match="No such file"):
        Controller(tmp_path / "none.onnx")
    with pytest.raises(ArtifactError, match="directory"):
        Controller(tmp_path)


LOADS = """
import sys
from loopwright.serving import ArtifactError, Controller
for path in sys.argv[1:]:
    try:
        Controller(path)
    except ArtifactError as error:
        print(error)
"""


def test_what_is_no_regular_file_is_refused_at_once(tmp_path: Path) -> None:
    """In a process of its own with little memory: a pipe would wait for ever, /dev/zero has no end."""
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "link").symlink_to("/dev/zero")
    (tmp_path / "loop").symlink_to(tmp_path / "loop")
    with socket.socket(socket.AF_UNIX) as listening:
        listening.bind(str(tmp_path / "s"))
        paths = [tmp_path / "pipe", "/dev/zero", tmp_path / "link", tmp_path / "s", tmp_path, tmp_path / "loop"]
        done = subprocess.run(
            [sys.executable, "-c", LOADS, *map(str, paths)],
            capture_output=True,
            text=True,
            timeout=60,
            preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_AS, (2**32, 2**32)),
        )
    assert done.returncode == 0, done.stderr
    kinds = ["a pipe", "a device", "a device", "a socket", "a directory", "symbolic links"]
    for line, path, kind in zip(done.stdout.splitlines(), paths, kinds, strict=True):
        assert line.startswith(f"{path}: ")
        assert kind in line


@pytest.mark.parametrize("name", ["missing.onnx", "a\0b"])
def test_a_file_that_cannot_be_read_is_one_error_of_one_line(tmp_path: Path, name: str) -> None:
    with pytest.raises(ArtifactError, match="cannot be read") as caught:
        Controller(tmp_path / name)
    shown = "".join(traceback.format_exception(caught.value))
    assert shown.count("Traceback") == 1
    assert "\n" not in str(caught.value)


def test_a_pinned_digest_refuses_another_file(pi_file: Path, controller: Controller) -> None:
    Controller(pi_file, sha256=controller.sha256.upper())
    with pytest.raises(ArtifactError, match="not the pinned"):
        Controller(pi_file, sha256="0" * 64)


def test_a_foreign_model_is_refused(pi_file: Path, tmp_path: Path) -> None:
    foreign = onnx.load(pi_file)
    del foreign.metadata_props[:]
    onnx.save(foreign, tmp_path / "foreign.onnx")
    with pytest.raises(ArtifactError, match="not a controller"):
        Controller(tmp_path / "foreign.onnx")
    with pytest.raises(ArtifactError, match="no Loopwright controller"):
        Controller(sealed(tmp_path / "foreign.onnx", foreign, None))


def test_a_manifest_that_does_not_fit_its_graph_is_refused(
    pi_file: Path, controller: Controller, tmp_path: Path
) -> None:
    model, path = onnx.load(pi_file), tmp_path / "x.onnx"
    m = json.loads(controller.manifest.to_json())
    wrong: list[tuple[dict[str, Any], str]] = [
        ({"n_state": 3}, "the graph's inputs are"),
        ({"info": ["error"]}, "the graph's outputs are"),
        ({"inputs": ["sp", "pv", "state"]}, "the graph's inputs are"),
        ({"pv": m["pv"][:1]}, "the graph's inputs are"),
        ({"inputs": ["sp", "pv", "mv", "state"]}, "allowed are sp, pv, dv, mv_applied, state"),
        ({"schema": 2}, "schema 2"),
        ({"period_s": 0}, "must be positive"),
        ({"mv": []}, "no manipulated variable"),
        ({"mv": [{"name": "valve"}]}, "malformed"),
        ({"surprise": 1}, "unknown entries: surprise"),
        ({"sp": [{"name": "level", "unit": "m", "low": 1, "high": 1}]}, "low < high"),
    ]
    for changed, message in wrong:
        with pytest.raises(ArtifactError, match=message) as caught:
            Controller(sealed(path, model, edited(controller, **changed)))
        assert "\n" not in str(caught.value)
    for text in ("", "[]", "{", '{"schema": NaN}', "{}"):
        with pytest.raises(ArtifactError, match="manifest"):
            Controller(sealed(path, model, text))


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"n_state": True}, "n_state is True; it must be an integer"),
        ({"n_state": 2.0}, "n_state is 2.0; it must be an integer"),
        ({"n_state": 10**9}, "it must be 0 to 1000000"),
        ({"n_state": 10**200}, "it must be 0 to 1000000"),
        ({"period_s": 1e-300}, "must be positive, 1e-06 to 1e"),
        ({"period_s": 10**299}, "must be positive"),
        ({"period_s": True}, "True stands where a number belongs"),
        ({"period_s": "1"}, "'1' stands where a number belongs"),
        ({"schema": True}, "schema True"),
        ({"schema": 1.0}, "schema 1.0"),
        ({"law": 7}, "a name is 7"),
        ({"law": None}, "a name is None"),
        ({"case": "x" * 201}, "at most 200 characters"),
        ({"case": "x" * 2**20}, "the manifest has 10.* characters"),
        ({"case": "\ud800"}, "surrogates not allowed"),
        ({"info": "ab"}, "'ab' stands where a list belongs"),
        ({"info": ["a", 1]}, "a name is 1"),
        ({"inputs": {"sp": 1}}, "stands where a list belongs"),
        ({"provenance": []}, "stands where an object belongs"),
        ({"evidence": None}, "None stands where an object belongs"),
        ({"sp": [["level", "m", 0, 1]]}, "stands where an object belongs"),
        ({"sp": [{"name": "level", "unit": "m", "low": 0}]}, "a signal lacks 'high'"),
        ({"sp": [{"name": "level", "unit": "m", "low": 0, "high": 1, "x": 1}]}, "unknown entries: x"),
        ({"sp": [{"name": "level", "unit": 1, "low": 0, "high": 1}]}, "a name is 1"),
        ({"sp": [{"name": "level", "unit": "m", "low": False, "high": 1}]}, "False stands where a number belongs"),
        ({"mv": [{"name": "v", "unit": "%", "low": 0, "high": 1, "values": "01"}]}, "stands where a list belongs"),
        ({"mv": [{"name": "v", "unit": "%", "low": 0, "high": 1, "values": [0, True]}]}, "True stands where a number"),
        ({"mv": [{"name": "v", "unit": "%", "low": 0, "high": 1, "max_move": "1"}]}, "'1' stands where a number"),
        ({"mv": [{"name": "v", "unit": "%", "low": 0, "high": 1, "max_move": 0}]}, "max_move 0.0; it must be above 0"),
    ],
)
def test_a_manifest_of_wrong_types_or_sizes_is_refused(
    controller: Controller, changed: dict[str, Any], message: str
) -> None:
    with pytest.raises(ArtifactError, match=message) as caught:
        Manifest.from_json(edited(controller, **changed))
    assert "\n" not in str(caught.value)
    assert len(str(caught.value)) < 400


@pytest.mark.parametrize(
    ("value", "message"),
    [
        ("9" * 5000, "an integer of 5000 digits"),
        ("-" + "9" * 5000, "an integer of 5001 digits"),
        ("1e999", "1e999, which is not a finite number"),
        ("-1e999", "not a finite number"),
        ("NaN", "not a finite number"),
        ('{"a": 1, "a": 2}', "'a' twice"),
        ("[" * 21 + "]" * 21, "nested more than 20 deep"),
        ("[" * 100_000 + "]" * 100_000, "nested more|not JSON"),
        ('{"a":' * 100_000 + "1" + "}" * 100_000, "nested more|not JSON"),
    ],
    ids=lambda v: v[:12],
)
@pytest.mark.parametrize("entry", ["n_state", "period_s", "evidence"])
def test_a_manifest_with_a_monstrous_value_is_refused(
    controller: Controller, entry: str, value: str, message: str
) -> None:
    text = edited(controller, **{entry: "HERE"}).replace('"HERE"', value)
    with pytest.raises(ArtifactError, match=message) as caught:
        Manifest.from_json(text)
    assert "\n" not in str(caught.value)
    assert len(str(caught.value)) < 400


def test_a_manifest_with_an_entry_twice_is_refused(controller: Controller) -> None:
    text = controller.manifest.to_json()
    with pytest.raises(ArtifactError, match="'law' twice"):
        Manifest.from_json(text[:-1] + ', "law": "another"}')


def test_a_metadata_entry_of_no_controller_is_refused(pi_file: Path, tmp_path: Path) -> None:
    """onnxruntime takes session options from such an entry where the environment says so."""
    model = onnx.ModelProto.FromString(pi_file.read_bytes()[:-TRAILER_BYTES])
    model.metadata_props.append(onnx.StringStringEntryProto(key="ort_config", value="{}"))
    with pytest.raises(ArtifactError, match="metadata entry 'ort_config'"):
        Controller(write(tmp_path / "x.onnx", seal(model.SerializeToString())))


def test_a_file_is_read_as_onnx_whatever_its_fifth_byte_on(pi_file: Path, tmp_path: Path) -> None:
    """onnxruntime takes a file with "ORTM" there for its own format, which nobody audited."""
    model = onnx.ModelProto.FromString(pi_file.read_bytes()[:-TRAILER_BYTES])
    model.producer_name = "ORTM"
    data = model.SerializeToString()
    assert data[4:8] == b"ORTM"
    with pytest.raises(Exception, match="ORT model verification failed"):
        ort.InferenceSession(data)
    Controller(write(tmp_path / "x.onnx", seal(data)))


def narrowed(model: onnx.ModelProto) -> None:
    for value in (*model.graph.input, *model.graph.output):
        value.type.tensor_type.elem_type = TensorProto.FLOAT
    for tensor in model.graph.initializer:
        if tensor.data_type == TensorProto.DOUBLE:
            tensor.CopyFrom(numpy_helper.from_array(numpy_helper.to_array(tensor).astype(np.float32), tensor.name))


def branched(model: onnx.ModelProto) -> None:
    empty = helper.make_graph([], "branch", [], [])
    model.graph.node.append(helper.make_node("If", ["c"], ["y"], then_branch=empty, else_branch=empty))


def hidden_subgraph(model: onnx.ModelProto) -> None:
    model.graph.node[0].attribute.append(helper.make_attribute("body", helper.make_graph([], "g", [], [])))


def external(model: onnx.ModelProto) -> None:
    tensor = model.graph.initializer[0]
    tensor.data_location = TensorProto.EXTERNAL
    tensor.external_data.append(onnx.StringStringEntryProto(key="location", value="weights.bin"))


def function(model: onnx.ModelProto) -> None:
    model.functions.append(helper.make_function("own", "F", ["x"], ["y"], [], []))


def foreign_operator(model: onnx.ModelProto) -> None:
    model.graph.node[0].domain = "com.example"


def future_ir(model: onnx.ModelProto) -> None:
    model.ir_version = 11


def future_opset(model: onnx.ModelProto) -> None:
    model.opset_import[0].version = 22


def undefined(model: onnx.ModelProto) -> None:
    model.graph.node[0].input[0] = "nowhere"


def mistyped(model: onnx.ModelProto) -> None:
    """A sum of numbers and truth values."""
    model.graph.node.append(helper.make_node("Cast", ["pv"], ["truth"], to=TensorProto.BOOL))
    model.graph.node.append(helper.make_node("Add", ["pv", "truth"], ["sum"]))


def headless(model: onnx.ModelProto) -> None:
    model.ClearField("graph")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (narrowed, r"tensor\(float\)"),
        (branched, "operator If is not on the list"),
        (hidden_subgraph, "holds a subgraph"),
        (external, "lies outside the file"),
        (function, "functions"),
        (foreign_operator, "operator com.example"),
        (future_ir, "IR 11"),
        (future_opset, "opset 22"),
        (undefined, "reads 'nowhere', which nothing before it gives"),
        (mistyped, "onnxruntime does not load the graph"),
        (headless, "it has no graph"),
    ],
)
def test_a_graph_that_is_no_controllers_is_refused(
    pi_file: Path, controller: Controller, tmp_path: Path, change: Any, message: str
) -> None:
    model = onnx.load(pi_file)
    change(model)
    with pytest.raises(ArtifactError, match=message) as caught:
        Controller(sealed(tmp_path / "x.onnx", model, controller.manifest))
    assert "\n" not in str(caught.value)


def test_a_file_over_the_cap_is_not_even_read(tmp_path: Path) -> None:
    with (tmp_path / "big.onnx").open("wb") as file:
        file.truncate(65 * 2**20)
    with pytest.raises(ArtifactError, match="at most"):
        Controller(tmp_path / "big.onnx")


# ---------------------------------------------------------------------- wrong outputs
def test_an_output_outside_its_range_is_refused(pi_file: Path, controller: Controller, tmp_path: Path) -> None:
    """A graph that promises less than its manifest asks: the valve's range narrowed, a discrete valve."""
    narrow = [Signal("valve", "%", 0.0, 10.0).to_dict()]
    c = Controller(sealed(tmp_path / "x.onnx", onnx.load(pi_file), edited(controller, mv=narrow)))
    with pytest.raises(OutputError, match=r"valve = .* %, outside its range \[0, 10\] %"):
        c.step(**FEED)
    discrete = [Signal("valve", "%", 0.0, 100.0, (0.0, 100.0)).to_dict()]
    c = Controller(sealed(tmp_path / "x.onnx", onnx.load(pi_file), edited(controller, mv=discrete)))
    with pytest.raises(OutputError, match=r"it may be one of \[0.0, 100.0\]"):
        c.step(**FEED)
    assert c.step(**{**FEED, "mv_applied": [900.0]}).mv.tolist() == [100.0]


SLOW = Signal("valve", "%", 0.0, 100.0, max_move=5.0)


def slow_file(pi_file: Path, controller: Controller, folder: Path) -> Path:
    """A law that knows no rate, in a file whose manifest has one."""
    return sealed(folder / "slow.onnx", onnx.load(pi_file), edited(controller, mv=[SLOW.to_dict()]))


@pytest.mark.parametrize(
    ("level", "applied", "mv"),
    [
        (-2.8, 40.0, 44.94),
        (-2.9, 40.0, None),
        (4.8, 40.0, 35.06),
        (4.9, 40.0, None),
        (-8.0, 98.0, 100.0),  # the law's own end
        (-2.8, -1.0, 3.94),  # scaling carried the read-back below 0, where it counts as 0
        (-3.6, -1.0, 4.98),
        (-3.7, -1.0, None),
    ],
)
def test_an_output_further_from_the_applied_mv_than_it_moves_a_period_is_refused(
    pi_file: Path, controller: Controller, tmp_path: Path, level: float, applied: float, mv: float | None
) -> None:
    """The first step of the PI from a state of zeros moves by 1.3 times the error."""
    slow = Controller(slow_file(pi_file, controller, tmp_path))
    feed = {**FEED, "pv": [level, 300.0], "mv_applied": [applied], "state": [0.0, 0.0]}
    if mv is not None:
        assert slow.step(**feed).mv.tolist() == pytest.approx([mv], abs=1e-12)
        return
    with pytest.raises(OutputError, match="at most 5 % a period"):
        slow.step(**feed)


def test_rows_are_steps_bit_for_bit_and_refused_as_they_are(
    pi_file: Path, controller: Controller, tmp_path: Path
) -> None:
    slow, rng, n = Controller(slow_file(pi_file, controller, tmp_path)), np.random.default_rng(2), 200
    pv = np.column_stack([rng.uniform(-8, 8, n), np.full(n, 300.0)])
    pv[::17, 0] = np.nan
    given = {"sp": np.ones((n, 1)), "pv": pv, "mv_applied": rng.uniform(-1, 101, (n, 1)), "state": np.zeros((n, 2))}
    rows = VectorizedController(slow, n).step(**given, dv=np.zeros((n, 0)))
    refused = 0
    for k in range(n):
        try:
            one = slow.step(**{name: values[k] for name, values in given.items()})
        except (SampleError, OutputError):
            assert rows.refused[k]
            refused += 1
            continue
        assert not rows.refused[k]
        assert (one.mv.tolist(), one.state.tolist()) == (rows.mv[k].tolist(), rows.state[k].tolist())
    assert 20 < refused < n - 20


def test_rounding_refuses_no_move() -> None:
    """The sum of an applied MV and the largest move is rounded up or down."""
    s = Signal("valve", "%", 0.0, 100.0, max_move=0.1)
    applied = np.random.default_rng(0).uniform(0, 99, 1000)
    assert all(s.moves(a, a + 0.1) and s.moves(a + 0.1, a) for a in applied.tolist())
    assert not any(s.moves(a, a + 0.1 + 1e-6) for a in applied.tolist())
    on_off = Signal("valve", "%", 0.0, 100.0, (0.0, 100.0), max_move=0.1)
    assert on_off.moves(0.0, 100.0)


def test_a_limit_of_moves_needs_the_applied_mv(controller: Controller) -> None:
    text = edited(controller, mv=[SLOW.to_dict()], inputs=["sp", "pv", "state"])
    with pytest.raises(ArtifactError, match="does not read mv_applied"):
        Manifest.from_json(text)


def test_an_output_that_is_not_finite_is_refused(controller: Controller) -> None:
    """The error overflows: inf - inf."""
    with pytest.raises(OutputError, match=r"mv\[0\] = nan, which is not finite"):
        controller.step(sp=1e308, pv=[-1e308, 300.0], mv_applied=0.0, state=[0, 0])


# ---------------------------------------------------------------------- manifest
# Controls, overrides of direction and line breaks are refused, test_serving_cli.py.
names = st.text(st.characters(exclude_categories=("Cc", "Cf", "Cs", "Zl", "Zp")), min_size=1, max_size=8)
signals = st.builds(Signal, names, names, st.floats(-1e9, -1), st.floats(1, 1e9), st.none() | st.just((0.0, 1.0)))
vectors = st.lists(signals, max_size=3, unique_by=lambda s: s.name).map(tuple)


@settings(deadline=None, max_examples=25)
@given(
    st.builds(
        Manifest,
        case=names,
        law=names,
        period_s=st.floats(1e-3, 1e6),
        sp=vectors,
        pv=vectors,
        dv=vectors,
        mv=st.lists(signals, min_size=1, max_size=2, unique_by=lambda s: s.name).map(tuple),
        n_state=st.integers(0, 100),
        info=st.lists(names, max_size=3).map(tuple),
        inputs=st.lists(st.sampled_from(["sp", "pv", "dv", "mv_applied", "state"]), unique=True).map(tuple),
        provenance=st.dictionaries(names, names, max_size=2),
        evidence=st.dictionaries(names, st.floats(-1, 1), max_size=2),
    )
)
def test_manifest_survives_json(manifest: Manifest) -> None:
    assert Manifest.from_json(manifest.to_json()) == manifest


def test_step_is_bit_equal_to_plain_onnxruntime(pi_file: Path, controller: Controller) -> None:
    session = ort.InferenceSession(pi_file)
    feed = {k: np.atleast_1d(np.array(v, dtype=float)) for k, v in FEED.items()}
    assert all(np.array_equal(a, b) for a, b in zip(controller.step(**FEED), session.run(None, feed), strict=True))
