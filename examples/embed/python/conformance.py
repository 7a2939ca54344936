"""The kit's vectors through this package, on any machine and release: ``python conformance.py KIT [ANSWERS.json]``."""

import json
import sys
import time
from contextlib import suppress
from math import inf
from pathlib import Path

import numpy as np
import onnxruntime

from loopwright.serving import Controller, ControlLoop, LoopError, Mode, OutputError, Sample, SampleError

OUTPUTS = ("mv", "state_next", "info")
kit = Path(sys.argv[1] if sys.argv[1:] else sys.exit("usage: python conformance.py KIT [ANSWERS.json]"))
vectors = json.loads((kit / "vectors.json").read_text())
controller = Controller(kit / vectors["file"], sha256=vectors["sha256"])
differences, wrong, took = {"one step": [0.0], "chained": [0.0]}, 0, []
if vectors["kit"] != 6:
    sys.exit(f"{kit} has the version {vectors['kit']}, not 6: write it again with loopwright conformance FILE.onnx KIT")


def numbers(texts):
    return None if texts is None else np.array([float.fromhex(text) for text in texts])


def answer(run, name, ours, theirs):
    """Our numbers as text; their difference from the kit's counts where the kit gives some."""
    if theirs is not None:
        differences[run].extend((np.abs(ours - numbers(theirs)) / numbers(vectors["scale"][name])).tolist())
    return [value.hex() for value in ours.tolist()]


answers = {}
for run in differences:
    answers[run] = []
    for row in vectors["steps"]:
        given = dict.fromkeys(("sp", "pv", "mv_applied")) | {
            name: numbers(texts) for name, texts in row["given"].items()
        }
        begin = given.pop("state")
        if run == "one step" or row["begins"]:
            state = begin
        began = time.perf_counter()
        try:
            result = controller.step(**given, state=state)
        except (SampleError, OutputError) as error:
            found = {"refused": "input" if isinstance(error, SampleError) else "output"}
        else:
            took.append(1e6 * (time.perf_counter() - began))
            state = result.state
            of = row.get("gives", {})
            found = {name: answer(run, name, ours, of.get(name)) for name, ours in zip(OUTPUTS, result, strict=True)}
        wrong += found.get("refused") != row.get("refused")
        answers[run].append(found)

begin, scans, before = vectors["loop"], [], None
setting = {name: begin[name] for name in ("recover_after", "max_gap")}
setting["learns"] = False  # one step a scan, as hosts in other languages do
loop = ControlLoop(controller, sp=numbers(begin["sp"]), mv=numbers(begin["mv"]), mode=Mode.AUTO, **setting)
for row in vectors["scans"]:
    if row["set_mode"]:
        loop.set_mode(Mode(row["set_mode"]))
    if row["set_mv"]:
        with suppress(LoopError):  # it may have to be refused
            loop.set_mv(numbers(row["set_mv"]))
    if row["unwritten"]:  # the command of the scan before did not arrive
        loop.unwritten(before, "the plant cannot be written")
    if row["missed"]:
        loop.gap(row["missed"])
    before = loop.mv
    if row["sample"] is None:
        command = loop.miss("the plant cannot be read")
    else:
        sample = {name: numbers(row["sample"][name]) for name in ("pv", "mv_applied", "dv")}
        command = loop.scan(Sample(**sample, age_s=float.fromhex(row["sample"]["age_s"])))
    found = {"mode": str(command.mode), "fault": bool(command.fault)}
    wrong += any(found[name] != row[name] for name in found) or command.writes == (row["mv"] is None)
    found["mv"] = answer("chained", "mv", command.mv, row["mv"]) if command.writes else None
    scans.append(found)

largest, sensitivity = (max(inf if d != d else d for d in found) for found in differences.values())
p50, steps = float(np.median(took)), len(vectors["steps"])
said = f"{steps} steps, {len(scans)} scans, largest difference {largest:.3g}, chained {sensitivity:.3g}, {wrong} wrong"
print(f"Python, onnxruntime {onnxruntime.__version__}: {said}, step p50 {p50:.1f} us")
if sys.argv[2:]:
    host = {"host": "Python", "onnxruntime": onnxruntime.__version__, "sha256": controller.sha256, "p50_us": p50}
    rows = {"steps": answers["one step"], "chained": answers["chained"], "scans": scans}
    Path(sys.argv[2]).write_text(json.dumps(host | rows))
tolerance, chained_tolerance = (float.fromhex(vectors[name]) for name in ("tolerance", "chained_tolerance"))
sys.exit(largest > tolerance or sensitivity > chained_tolerance or wrong > 0)
