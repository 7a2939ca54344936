"""A controller described for a person, in plain text."""

from __future__ import annotations

import json
from typing import Any

from loopwright.serving.controller import Controller
from loopwright.serving.manifest import Signal
from loopwright.serving.proof import judged
from loopwright.serving.trust import ending, signer
from loopwright.serving.words import plain

SHOWN = {
    "scenarios",
    "units",
    "locked_up",
    "as_printed",
    "swings",
    "beyond_reach",
}  # entries of the evidence that have a place of their own


def card(controller: Controller) -> str:
    """Text about the controller: its law, signals, origin and validation."""
    m, graph = controller.manifest, controller.summary
    lines = [
        f"{m.law} for {m.case}",
        f"  file      {controller.path} ({controller.size_bytes / 1024:.1f} KiB)",
        f"  sha256    {controller.sha256}",
        f"  period    {m.period_s:g} s",
        f"  graph     {graph.nodes} operators, opset {graph.opset}, IR {graph.ir_version}",
    ]
    if signed := signer(controller):
        lines[3:3] = [f"  signed    by {signed.words}", *(f"            {words}" for words in ending(controller))]
    first = _locked_up(m.evidence) or [f"  NOT PROVEN: {why}" for why in filter(None, [judged(m).why])]
    lines[1:1] = [*first, *_swings(m.evidence), *_beyond_reach(m.evidence), *_doubtful(m.evidence)]
    for title, name in (("set points", "sp"), ("process variables", "pv"), ("measured disturbances", "dv")):
        idle = " (this law does not take them)" * (name == "dv" and "dv" not in m.inputs)
        lines += _signals(title + idle, m.signals(name))
    lines += _signals("manipulated variables", m.mv)
    outputs = ["mv"] + ["state_next"] * bool(m.n_state) + ["info"] * bool(m.info)
    lines += ["", f"inputs      {', '.join(m.inputs)}", f"outputs     {', '.join(outputs)}"]
    lines += [f"state       {m.n_state} numbers, all zero: no past", f"info        {', '.join(m.info) or '-'}"]
    lines += ["", "provenance"] + (_tree(m.provenance) or ["  -"])
    lines += ["", "evidence"] + (_evidence(m.evidence) or ["  none yet: this controller was not validated"])
    return "\n".join(map(plain, lines))  # provenance and evidence hold any text


def card_json(controller: Controller) -> str:
    """The manifest and the file's own figures as JSON."""
    graph = controller.summary
    file: dict[str, Any] = {"path": str(controller.path), "bytes": controller.size_bytes, "sha256": controller.sha256}
    if signed := signer(controller):
        file["signed"] = signed.to_dict()
    versions = {"opset": graph.opset, "ir_version": graph.ir_version, "ops": graph.ops}
    return json.dumps({**json.loads(controller.manifest.to_json()), "file": file, "graph": versions}, indent=2)


def _signals(title: str, signals: tuple[Signal, ...]) -> list[str]:
    if not signals:
        return []
    width = max(len(s.name) for s in signals)
    rows = []
    for s in signals:
        allowed = f"{s.low:g} .. {s.high:g}" if s.values is None else f"one of {', '.join(f'{v:g}' for v in s.values)}"
        unit = "" if s.unit == "-" else f" {s.unit}"
        moves = "" if s.max_move is None else f", moves at most {s.max_move:g}{unit} a period"
        rows.append(f"  {s.name:<{width}}  {allowed}{unit}{moves}")
    return ["", title, *rows]


def _locked_up(evidence: dict[str, Any]) -> list[str]:
    """The first thing to know of a controller that locked up while it was validated; nothing of any other."""
    count, tests = evidence.get("lock_ups"), evidence.get("locked_up")
    if not isinstance(count, int) or count <= 0:
        return []
    lines = [
        f"  LOCKED UP in {count} closed loop{'s' if count > 1 else ''} of its validation: do not run it on a plant"
    ]
    lines += _by_test(tests)
    if evidence.get("as_printed") is True:
        lines.append("    shipped as printed, to reproduce a paper")
    return lines


def _beyond_reach(evidence: dict[str, Any]) -> list[str]:
    """Tests with holds that count as no lock-up, because no control gets to their set point in time."""
    tests = evidence.get("beyond_reach")
    if not isinstance(tests, dict) or not tests:
        return []
    return ["  holds at an end of the MVs whose set point no control gets to in time, no lock-ups", *_by_test(tests)]


def _swings(evidence: dict[str, Any]) -> list[str]:
    """Tests in which a closed loop swung to the end."""
    tests = evidence.get("swings")
    if not isinstance(tests, dict) or not tests:
        return []
    counts = [n for seeds in tests.values() if isinstance(seeds, dict) for n in seeds.values() if isinstance(n, int)]
    count = sum(counts)
    return [f"  SWINGS to the end in {count} closed loop{'s' * (count != 1)} of its validation", *_by_test(tests)]


def _doubtful(evidence: dict[str, Any]) -> list[str]:
    """The screening's verdict on the record behind the models of the tests, unless it is good."""
    grounds = evidence.get("on")
    if not isinstance(grounds, dict) or grounds.get("data") in (None, "", "yes"):
        return []
    reasons = grounds.get("data_reasons")
    why = "; ".join(map(str, reasons)) if isinstance(reasons, list) else ""
    return [f"  DATA: can they carry a model: {grounds['data']}" + f" ({why})" * bool(why)]


def _by_test(tests: object) -> list[str]:
    """A line for each test: its data seeds with their closed loops."""
    lines = []
    for test, seeds in tests.items() if isinstance(tests, dict) else ():
        named = ", ".join(f"seed {seed}: {n}" for seed, n in seeds.items()) if isinstance(seeds, dict) else seeds
        lines.append(f"    {test} ({named})")
    return lines


def _evidence(evidence: dict[str, Any]) -> list[str]:
    """A table where the evidence is figures by scenario, else an indented list."""
    rows = evidence.get("scenarios", evidence)
    if not rows or not all(isinstance(row, dict) for row in rows.values()):
        return _tree(evidence)
    columns = list(dict.fromkeys(key for row in rows.values() for key, v in row.items() if isinstance(v, int | float)))
    if not columns:
        return _tree(evidence)
    units = evidence.get("units")
    named = {c: f"{c} [{units[c]}]" if isinstance(units, dict) and c in units else c for c in columns}
    first = max(len(name) for name in rows)
    widths = [max(10, len(words)) for words in named.values()]
    lines = ["  " + " " * first + "".join(f"  {w:>{n}}" for w, n in zip(named.values(), widths, strict=True))]
    for name, row in rows.items():
        cells = (f"{row[c]:.4g}" if isinstance(row.get(c), int | float) else "-" for c in columns)
        lines.append(f"  {name:<{first}}" + "".join(f"  {c:>{w}}" for c, w in zip(cells, widths, strict=True)))
    return lines + _tree({k: v for k, v in evidence.items() if rows is not evidence and k not in SHOWN})


def _tree(values: dict[str, Any], indent: int = 2) -> list[str]:
    lines = []
    for key, value in values.items():
        if isinstance(value, dict):
            lines += [f"{' ' * indent}{key}", *_tree(value, indent + 2)]
        else:
            text = ", ".join(map(str, value)) if isinstance(value, list) else str(value)
            lines.append(f"{' ' * indent}{key}: {text}")
    return lines
