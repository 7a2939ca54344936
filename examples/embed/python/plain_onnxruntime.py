"""The same without Loopwright: ``python plain_onnxruntime.py FILE.onnx`` (numpy and onnxruntime alone)."""

import json
import sys

import numpy as np
import onnxruntime as ort

file = sys.argv[1] if sys.argv[1:] else sys.exit("usage: python plain_onnxruntime.py FILE.onnx")
options = ort.SessionOptions()
options.intra_op_num_threads = 1
net = ort.InferenceSession(file, options, providers=["CPUExecutionProvider"])
m = json.loads(net.get_modelmeta().custom_metadata_map["loopwright.manifest"])
low, high, most = np.array([[s["low"], s["high"], s.get("max_move", np.inf)] for s in m["mv"]]).T  # of continuous MVs
state, mv, operate = np.zeros(m["n_state"]), low, [e["default"] for e in m.get("operate", [])]  # mv: your read-back
for k in range(100):  # once every m["period_s"] seconds
    feed = {i.name: np.full(i.shape, float(i.name == "fresh")) for i in net.get_inputs()}  # ahead: nothing is to come
    feed |= {n: np.array([(s["low"] + s["high"]) / 2 for s in m[n]]) for n in ("sp", "dv")}
    pv = np.array([s["low"] + (s["high"] - s["low"]) * (k % 10) / 10 for s in m["pv"]])
    feed |= {"pv": pv, "mv_applied": mv, "state": state, "operate": np.array(operate)}
    out = {o.name: v for o, v in zip(net.get_outputs(), net.run(None, {n: feed[n] for n in m["inputs"]}), strict=True)}
    old, mv, state, info = mv, out["mv"], out.get("state_next", state), out.get("info", np.zeros(0))
    allowed = (low <= mv) & (mv <= high) & (abs(mv - old) <= most * (1 + 1e-9))  # the runtime also checks the file
    print(mv.tolist(), dict(zip(m["info"], info.tolist(), strict=True))) if allowed.all() else sys.exit("no MV")
