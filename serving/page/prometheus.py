"""The state of a loop as Prometheus text, exposition format 0.0.4."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from typing import Any

from loopwright.serving.words import plain

MODES = ("SHADOW", "MANUAL", "AUTO", "HOLD")
LEVELS = {"not known yet": -1, "as validated": 0, "watch": 1, "retrain": 2}
GROUPS = (
    ("setpoint", "sp", "sp", "Set point, in the signal's unit."),
    ("process_variable", "pv", "pv", "Process variable, in the signal's unit."),
    ("manipulated_variable", "mv", "mv", "Manipulated variable that the loop asks for; none in SHADOW."),
    ("applied", "applied", "mv", "Manipulated variable that the actuator has."),
    ("law", "law", "mv", "Manipulated variable that the law wants."),
)


def metrics_text(about: Mapping[str, Any], state: Mapping[str, Any]) -> str:
    """One gauge or counter a line, each family with its help."""
    lines: list[str] = []
    for name, kind, words, rows in _families(about, state):
        lines += [f"# HELP loopwright_{name} {words}", f"# TYPE loopwright_{name} {kind}"]
        lines += [f"loopwright_{name}{_labels(labels)} {float(value)!r}" for labels, value in rows if value is not None]
    return "\n".join(lines) + "\n"


def _families(about: Mapping[str, Any], state: Mapping[str, Any]) -> Iterator[tuple[str, str, str, Iterable[Any]]]:
    none: Mapping[str, str] = {}
    card = about["card"]
    info = {"law": card["law"], "case": card["case"], "sha256": card["sha256"], "file": card["file"]}
    yield "controller_info", "gauge", "The controller in charge.", [(info, 1)]
    yield "up", "gauge", "1 while the loop scans.", [(none, int(state["alive"]))]
    yield "mode", "gauge", "1 for the present mode.", [({"mode": m}, int(m == state["mode"])) for m in MODES]
    for name, words in (
        ("scans", "Scans since the loop's start."),
        ("missed", "Periods without a scan, because the machine was late."),
        ("faults", "Scans with a fault."),
        ("connections", "Connections that were made to the plant's server."),
    ):
        value = state.get({"scans": "scan"}.get(name, name))
        yield f"{name}_total", "counter", words, [(none, value)]
    yield "last_scan_seconds", "gauge", "Time of the last scan, since 1970.", [(none, state["time"])]
    yield "journal_ok", "gauge", "1 while the journal can be written.", [(none, int(not state.get("journal")))]
    lost = "Scans and events that the journal has lost, or never got because the disk took none."
    yield "journal_lost_total", "counter", lost, [(none, state.get("journal_lost"))]
    for name, key, group, words in GROUPS:
        signals = about["signals"][group]
        values = state.get(key) or [None] * len(signals)
        rows = [({"signal": s["name"], "unit": s["unit"]}, v) for s, v in zip(signals, values, strict=False)]
        yield name, "gauge", words, rows
    infos = zip(about["info"], state.get("info") or [], strict=False)
    yield "info", "gauge", "Numbers that the law tells of itself.", [({"name": name}, v) for name, v in infos]
    yield from _operated(about, state)
    numbers = state.get("numbers") or {}
    yield "monitor", "gauge", "Numbers that the monitor has measured.", [({"name": n}, v) for n, v in numbers.items()]
    week = [({"name": n}, v) for n, v in (state.get("week") or {}).items() if n != "began"]
    yield "week", "gauge", "Time on control this week (from Monday, UTC), and what bound signals in AUTO.", week
    verdicts = state.get("verdicts") or []
    levels = [({"name": v["name"]}, LEVELS[v["level"]]) for v in verdicts if v["level"] in LEVELS]
    words = "Is the controller still right? 0 as validated, 1 watch, 2 retrain, -1 not known yet."
    yield "verdict", "gauge", words, levels


def _operated(about: Mapping[str, Any], state: Mapping[str, Any]) -> Iterator[tuple[str, str, str, Iterable[Any]]]:
    """Values of ``operate``, and signals that the law does without; nothing of a law that does not read it."""
    entries = about.get("operate") or []
    if not entries:
        return
    values = list(zip(entries, state.get("operate") or [], strict=False))
    rows = [({k: e[k] for k in ("name", "signal", "what", "unit")}, v) for e, v in values]
    yield "operate", "gauge", "Value of an entry of operate, in its unit, as operators want it.", rows
    bridged, shed = state.get("bridged") or {}, state.get("shed") or {}
    used = [({"signal": e["signal"]}, v if e["signal"] not in shed else 0.0) for e, v in values if e["what"] == "use"]
    yield "in_use", "gauge", "1 while the law controls a variable, or moves an MV.", used
    pv = [s["name"] for s in about["signals"]["pv"]]
    for name, words, of in (
        ("bridged", "1 while the law predicts a process variable, because its reading is bad.", bridged),
        ("shed", "1 while a process variable is left out, because its reading stays bad.", shed),
    ):
        yield name, "gauge", words, [({"signal": n}, float(n in of)) for n in pv]


def _labels(labels: Mapping[str, Any]) -> str:
    """Labels in braces, with what the format forbids in a value escaped."""
    if not labels:
        return ""
    escaped = {k: plain(str(v)).replace("\\", r"\\").replace('"', r"\"") for k, v in labels.items()}
    return "{" + ",".join(f'{k}="{v}"' for k, v in escaped.items()) + "}"
