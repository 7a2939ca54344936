"""The kit's vectors through this package: ``python conformance.py KIT [ANSWERS.json]``, on any machine and release."""

import json
import sys
from pathlib import Path

import numpy as np
import onnxruntime

from serving import Controller, ControlLoop, Mode, OutputError, Sample, SampleError

kit = Path(sys.argv[1] if sys.argv[1:] else sys.exit("usage: python conformance.py KIT [ANSWERS.json]"))
vectors = json.loads((kit / "vectors.json").read_text())
controller = Controller(kit / vectors["file"], sha256=vectors["sha256"])
inputs, largest, wrong = controller.manifest.inputs, 0.0, 0


def numbers(texts):
    return None if texts is None else np.array([float.fromhex(text) for text in texts])


def compared(name, ours, theirs):
    global largest
    shares = np.abs(numbers(theirs) - ours) / numbers(vectors["scale"][name])
    largest = max([largest, *shares.tolist()])
    return [value.hex() for value in ours.tolist()]


state, steps = controller.cold_state(), []
for row in vectors["steps"]:
    given = {name: numbers(texts) for name, texts in row["given"].items()}
    given = {
        name: given.get(name, [s.middle for s in controller.manifest.signals(name)])
        for name in ("sp", "pv", "dv", "mv_applied")
    }
    try:
        result = controller.step(**given, state=controller.cold_state() if row["cold"] else state)
    except (SampleError, OutputError) as error:
        steps.append({"refused": "input" if isinstance(error, SampleError) else "output"})
        wrong += row.get("refused") != steps[-1]["refused"]
        continue
    if "refused" in row:
        wrong += 1
    state, outputs = result.state, zip(("mv", "state_next", "info"), result, strict=True)
    gives = row.get("gives", {})
    steps.append(
        {name: compared(name, value, gives.get(name, [v.hex() for v in value.tolist()])) for name, value in outputs}
    )

begin, scans = vectors["loop"], []
loop = ControlLoop(
    controller,
    sp=numbers(begin["sp"]),
    mv=numbers(begin["mv"]),
    mode=Mode.AUTO,
    recover_after=begin["recover_after"],
    max_gap=begin["max_gap"],
)
for row in vectors["scans"]:
    if row["set_mode"]:
        loop.set_mode(Mode(row["set_mode"]))
    if row["missed"]:
        loop.gap(row["missed"])
    s = row["sample"]
    if s is None:
        command = loop.miss("the plant cannot be read")
    else:
        command = loop.scan(
            Sample(numbers(s["pv"]), numbers(s["mv_applied"]), numbers(s["dv"]), float.fromhex(s["age_s"]))
        )
    scans.append(
        {"mode": str(command.mode), "fault": bool(command.reason), "mv": compared("mv", command.mv, row["mv"])}
    )
    wrong += (scans[-1]["mode"], scans[-1]["fault"]) != (row["mode"], row["fault"])

done = f"{len(steps)} steps, {len(scans)} scans, largest difference {largest:.3g}, {wrong} wrong"
print(f"Python, onnxruntime {onnxruntime.__version__}: {done}")
if sys.argv[2:]:
    answers = {"host": "Python", "onnxruntime": onnxruntime.__version__, "sha256": controller.sha256}
    Path(sys.argv[2]).write_text(json.dumps(answers | {"steps": steps, "scans": scans}))
sys.exit(largest > float.fromhex(vectors["tolerance"]) or wrong > 0)
