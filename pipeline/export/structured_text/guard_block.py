"""The guard around the step as Structured Text: the cases of ``serving.guard``, the manifest's numbers as constants.

The text is ``guard.st``. A line ``//IF NAME`` begins what a law without NAME leaves out, ``//END`` ends it.
``TABLE`` is an array with its values, ``ROOM`` one of zeros, ``FLAGS`` one of FALSE, ``TOP_PV`` the last place of a PV.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from importlib.resources import files

from loopwright.pipeline.export.structured_text.iec_names import array_of, comment, field_names, lreal
from loopwright.pipeline.export.structured_text.step_block import StepBlock
from loopwright.serving.bridging import BRIDGE_PERIODS
from loopwright.serving.manifest import SWITCHES, Manifest, Signal

# What stands for each input of a step in the guard.
_IN_GUARD = {
    "sp": "sp_used", "pv": "pv_used", "dv": "dv", "mv_applied": "applied", "operate": "operate_now",
    "fresh": "fresh_now", "ahead": "ahead",
}  # fmt: skip


def printed_guard(m: Manifest, name: str, step: StepBlock) -> list[str]:
    """The texts of the guard's functions and of the block ``NAME_guard``, each with its comment."""
    sizes = {n: len(getattr(m, n)) for n in ("sp", "pv", "dv", "mv", "info", "operate")}
    sizes |= {"state": m.n_state, "ahead": 0 if m.ahead is None else m.ahead.size}
    has = {n.upper() for n, count in sizes.items() if count} | {n.upper() for n in m.inputs}
    has -= {"DV"} - {n.upper() for n in m.inputs}
    text = _chosen(files("loopwright.pipeline.export.structured_text").joinpath("guard.st").read_text("utf-8"), has)
    tables = _tables(m)
    given = [f"{n} := {_IN_GUARD[n]}" for n in step.inputs] + (["restart := is_cold"] if m.n_state else [])
    for pattern, found in (
        (r"TABLE (\w+)", lambda t: tables[t[1]]),
        (r"ROOM (\w+)", lambda t: f"ARRAY[0..{max(sizes[t[1].lower()], 1) - 1}] OF LREAL"),
        (r"FLAGS (\w+)", lambda t: f"ARRAY[0..{sizes[t[1].lower()] - 1}] OF BOOL"),
        (r"\bTOP_(\w+)", lambda t: str(sizes[t[1].lower()] - 1)),
        (r"\bN_AHEAD_SIGNALS\b", lambda t: str(sizes["sp"] + sizes["dv"])),
        (r"\bBRIDGE_S\b", lambda t: lreal(BRIDGE_PERIODS * m.period_s)),
        (r"\bPERIOD_S\b", lambda t: lreal(m.period_s)),
        (r"\bOPERATE_FIELDS\b", lambda t: "\n".join(_fields_read(m))),
        (r"\bPRESENT_VALUE\b", lambda t: _present(sizes)),
        (r"\bCALL\b", lambda t: ", ".join(given)),
        (r"\bname_", lambda t: f"{name}_"),
    ):
        text = re.sub(pattern, found, text)
    return [part.strip() + "\n" for part in re.split(r"(?<=\nEND_FUNCTION)\n", text)]


def printed_operate_type(m: Manifest, name: str) -> str:
    """The STRUCT of what operators change, each entry with its default; empty where the law has none."""
    if not m.operate:
        return ""
    names = field_names([e.name for e in m.operate])
    rows = [
        f"    {field} : LREAL := {lreal(e.default)}; "
        f"(* {comment(f'{e.name} {e.unit}'.strip())}, {lreal(e.low)} to {lreal(e.high)} *)"
        for field, e in zip(names, m.operate, strict=True)
    ]
    return "\n".join([f"TYPE {name}_operate :", "STRUCT", *rows, "END_STRUCT;", "END_TYPE\n"])


def _chosen(text: str, has: set[str]) -> str:
    """The lines of what the law has."""
    kept, here = [], [True]
    for line in text.splitlines():
        words = line.split()
        if words[:1] == ["//IF"]:
            here.append(words[-1] in has if words[1] != "NOT" else words[-1] not in has)
        elif words[:1] == ["//END"]:
            here.pop()
        elif all(here):
            kept.append(line)
    assert here == [True]
    return "\n".join(kept) + "\n"


def _tables(m: Manifest) -> Mapping[str, str]:
    """Each array of ``guard.st`` with its values."""
    tables = {"ONES": array_of("LREAL", [1.0] * len(m.pv))}
    for kind in ("sp", "pv", "mv"):
        signals: Sequence[Signal] = getattr(m, kind)
        tables[f"{kind.upper()}_LOW"] = array_of("LREAL", [s.low for s in signals] or [0.0])
        tables[f"{kind.upper()}_HIGH"] = array_of("LREAL", [s.high for s in signals] or [0.0])
        middle = [s.middle if kind != "pv" else 0.5 * (s.low + s.high) for s in signals]
        tables[f"{kind.upper()}_MIDDLE"] = array_of("LREAL", middle or [0.0])
    moves = [0.0 if s.max_move is None or s.values else s.max_move for s in m.mv]
    first = [0]
    for s in m.mv:
        first.append(first[-1] + len(s.values or ()))
    tables |= {
        "MV_MAX_MOVE": array_of("LREAL", moves),
        "MV_VALUES": array_of("LREAL", [v for s in m.mv for v in s.values or ()] or [0.0]),
        "MV_FIRST": array_of("DINT", first),
    }
    if m.operate:
        names = [e.name for e in m.operate]
        above = [names.index(f"{e.signal}.high") if e.what == "low" else k for k, e in enumerate(m.operate)]
        uses = {e.signal: k for k, e in enumerate(m.operate) if e.group == "cv" and e.what == "use"}
        tables |= {
            "OPERATE_DEFAULT": array_of("LREAL", [e.default for e in m.operate]),
            "OPERATE_LOW": array_of("LREAL", [e.low for e in m.operate]),
            "OPERATE_HIGH": array_of("LREAL", [e.high for e in m.operate]),
            "OPERATE_SWITCH": array_of("BOOL", [e.what in SWITCHES for e in m.operate]),
            "OPERATE_ABOVE": array_of("DINT", above),
            "USE_OF_PV": array_of("DINT", [uses.get(s.name, -1) for s in m.pv]),
        }
    if m.ahead is not None:
        tables |= {
            "AHEAD_LOW": array_of("LREAL", [s.low for s in m.ahead.signals]),
            "AHEAD_HIGH": array_of("LREAL", [s.high for s in m.ahead.signals]),
        }
    return tables


def _fields_read(m: Manifest) -> list[str]:
    names = field_names([e.name for e in m.operate])
    return [f"operate_wanted[{k}] := operate.{field};" for k, field in enumerate(names)]


def _present(sizes: Mapping[str, int]) -> str:
    """Statements for the present value at a place of ``ahead``: a set point or a measured disturbance."""
    if not sizes["dv"]:
        return "present := sp_used[place];"
    n = sizes["sp"]
    lines = [
        f"IF place < {n} THEN",
        "    present := sp_used[place];",
        "ELSE",
        f"    present := dv[place - {n}];",
        "END_IF;",
    ]
    return "\n        ".join(lines)
