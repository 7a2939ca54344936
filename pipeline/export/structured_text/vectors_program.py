"""The conformance kit as a PROGRAM that runs on the PLC itself: one step and one scan a cycle, then a verdict."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from loopwright.pipeline.export.plain_code.self_test import MODES, KitInC
from loopwright.pipeline.export.plain_code.statements import Floats
from loopwright.pipeline.export.structured_text.iec_names import array_of, typed
from loopwright.pipeline.export.structured_text.step_block import StepBlock
from loopwright.serving.conformance.kit import CHAIN_TOLERANCE, read_all
from loopwright.serving.manifest import Manifest
from loopwright.serving.modes import Mode

MOST_NUMBERS = 6000  # of steps in the program: a PLC's memory is small; the tests here run all steps of the kit
BEYOND = 1.0e308  # stands for a number of the kit that is not finite: ten times it is infinite


def steps_taken(kit: KitInC) -> list[int]:
    """Steps of the kit that the program has, spread over it."""
    width = sum(v.shape[1] for of in (kit.given, kit.ours) for v in of.values())
    steps = len(next(iter(kit.given.values())))
    few = max(1, min(steps, MOST_NUMBERS // width))
    return sorted({int(k) for k in np.linspace(0, steps - 1, few)})


def printed_vectors_program(m: Manifest, name: str, step: StepBlock, kit: KitInC) -> str:
    """``NAME_test``: ``done`` after all, ``steps_wrong`` and ``scans_wrong`` are 0 where this PLC does as it must.

    A number of a step is wrong unless it is equal; an MV of a scan may differ by the kit's tolerance.
    """
    taken = steps_taken(kit)
    given = {n: kit.given[n][taken] for n in (*step.inputs, *(["state"] if m.n_state else []))}
    wanted = {n: v[taken] for n, v in kit.ours.items() if v.size}
    scans = _scans(m, kit.scans)
    n_mv = len(m.mv)
    sp = read_all({"sp": kit.loop["sp"]}, "loop")["sp"]
    tables = [f"    given_{n} : {_flat(v)};" for n, v in given.items()]
    tables += [f"    wanted_{n} : {_flat(v)};" for n, v in wanted.items()]
    tables += [f"    scan_{n} : {text};" for n, text in scans.items()]
    tables.append(f"    tolerance : {array_of('LREAL', [CHAIN_TOLERANCE * (s.high - s.low) for s in m.mv])};")
    now = [f"    now_{n} : ARRAY[0..{v.shape[1] - 1}] OF LREAL;" for n, v in given.items()]
    read = ["pv", "mv_applied", *(["dv"] if "dv" in m.inputs else [])]
    columns = {n: len(m.signals(n)) for n in read} | {"mv_by_hand": n_mv}
    now += [f"    sample_{n} : ARRAY[0..{width - 1}] OF LREAL;" for n, width in columns.items()]
    if len(sp):
        now.append(f"    set_points : {array_of('LREAL', sp.tolist())};")
    call = ", ".join(f"{n} := now_{n}" for n in step.inputs)
    call += ", restart := TRUE, restart_state := now_state" if m.n_state else ""
    lines = [
        f"PROGRAM {name}_test",
        "VAR",
        "    done : BOOL; (* all is run: look at the two numbers below, which must be 0 *)",
        "    steps_wrong : DINT;",
        "    scans_wrong : DINT;",
        "    first_wrong_step : DINT := -1;",
        "    first_wrong_scan : DINT := -1;",
        "    step_number : DINT;",
        "    scan_number : DINT;",
        "    same : BOOL;",
        "    command : DINT;",
        "    difference : LREAL;",
        "    k : DINT;",
        f"    law : {name}_step;",
        f"    guard : {name}_guard;",
        *now,
        "END_VAR",
        *("VAR CONSTANT", *tables, "END_VAR"),
        f"IF step_number < {len(taken)} THEN",
        *(line for n, v in given.items() for line in _taken(f"now_{n}", f"given_{n}", v.shape[1], "step_number")),
        f"    law({call});",
        "    same := TRUE;",
        *(line for n, v in wanted.items() for line in _compared(n, v.shape[1])),
        "    IF NOT same THEN",
        "        steps_wrong := steps_wrong + 1;",
        "        IF first_wrong_step < 0 THEN",
        "            first_wrong_step := step_number;",
        "        END_IF;",
        "    END_IF;",
        "    step_number := step_number + 1;",
        "END_IF;",
        f"IF scan_number < {len(kit.scans)} THEN",
        *(line for n, w in columns.items() for line in _taken(f"sample_{n}", f"scan_{n}", w, "scan_number", True)),
        "    command := scan_mode_command[scan_number];",
        "    IF (scan_number = 0) AND (command < 0) THEN",
        "        command := 1; (* the kit begins in AUTO *)",
        "    END_IF;",
        f"    guard({_scan_call(m, kit, read)});",
        "    same := (guard.mode = scan_mode[scan_number]) AND ((guard.why > 0) = scan_fault[scan_number]);",
        "    same := same AND (guard.writes = scan_writes[scan_number]);",
        "    IF scan_writes[scan_number] THEN",
        f"        FOR k := 0 TO {n_mv - 1} DO",
        f"            difference := guard.mv[k] - scan_mv[{n_mv} * scan_number + k];",
        "            same := same AND (difference <= tolerance[k]) AND ((-difference) <= tolerance[k]);",
        "        END_FOR;",
        "    END_IF;",
        "    IF NOT same THEN",
        "        scans_wrong := scans_wrong + 1;",
        "        IF first_wrong_scan < 0 THEN",
        "            first_wrong_scan := scan_number;",
        "        END_IF;",
        "    END_IF;",
        "    scan_number := scan_number + 1;",
        "END_IF;",
        f"done := (step_number >= {len(taken)}) AND (scan_number >= {len(kit.scans)});",
        "END_PROGRAM\n",
    ]
    return "\n".join(lines)


def _flat(rows: Floats) -> str:
    return array_of("LREAL", rows.ravel().tolist())


def _taken(target: str, table: str, width: int, row: str, any_number: bool = False) -> list[str]:
    """A row of a table; with ``any_number`` one that need not be finite."""
    lines = [f"    FOR k := 0 TO {width - 1} DO", f"        {target}[k] := {table}[{width} * {row} + k];"]
    if any_number:
        lines += [
            f"        IF ({target}[k] >= {typed(BEYOND)}) OR ({target}[k] <= {typed(-BEYOND)}) THEN",
            f"            {target}[k] := {target}[k] * {typed(10.0)}; (* not finite *)",
            "        END_IF;",
        ]
    return [*lines, "    END_FOR;"]


def _compared(output: str, width: int) -> list[str]:
    held = "state" if output == "state_next" else output
    return [
        f"    FOR k := 0 TO {width - 1} DO",
        f"        IF law.{held}[k] <> wanted_{output}[{width} * step_number + k] THEN",
        "            same := FALSE;",
        "        END_IF;",
        "    END_FOR;",
    ]


def _scan_call(m: Manifest, kit: KitInC, read: Sequence[str]) -> str:
    given = {n: f"sample_{n}" for n in read}
    given |= {
        "sample_read": "scan_sample_read[scan_number]",
        "has_mv_applied": "scan_has_mv_applied[scan_number]",
        "age_s": "scan_age_s[scan_number]",
        "mode_command": "command",
        "send_mv": "scan_send_mv[scan_number]",
        "mv_by_hand": "sample_mv_by_hand",
        "unwritten": "scan_unwritten[scan_number]",
        "missed_periods": "scan_missed[scan_number]",
        "recover_after": str(int(kit.loop["recover_after"])),
        "max_gap": typed(float(kit.loop["max_gap"])),
    }
    if m.sp:
        given["sp"] = "set_points"
    return ", ".join(f"{n} := {value}" for n, value in given.items())


def _scans(m: Manifest, scans: Sequence[Mapping[str, Any]]) -> dict[str, str]:
    """Columns of the kit's scans, each an array with its values."""
    samples = [scan["sample"] or {} for scan in scans]

    def numbers(rows: Sequence[Sequence[str] | None], width: int) -> str:
        return array_of("LREAL", [v for row in rows for v in (map(_finite, row) if row else [0.0] * width)])

    read = {n: [s.get(n) for s in samples] for n in ("pv", "dv", "mv_applied")}
    columns = {n: numbers(read[n], len(m.signals(n))) for n in ("pv", "mv_applied")}
    if "dv" in m.inputs:
        columns["dv"] = numbers(read["dv"], len(m.dv))
    modes = [MODES.index(Mode(s["set_mode"])) if s["set_mode"] else -1 for s in scans]
    return columns | {
        "sample_read": array_of("BOOL", [s["sample"] is not None for s in scans]),
        "has_mv_applied": array_of("BOOL", [bool(v) for v in read["mv_applied"]]),
        "age_s": array_of("LREAL", [_finite(s.get("age_s", "0x0p0")) for s in samples]),
        "mode_command": array_of("DINT", modes),
        "send_mv": array_of("BOOL", [s["set_mv"] is not None for s in scans]),
        "unwritten": array_of("BOOL", [bool(s["unwritten"]) for s in scans]),
        "missed": array_of("LREAL", [float(s["missed"]) for s in scans]),
        "mode": array_of("DINT", [MODES.index(Mode(s["mode"])) for s in scans]),
        "fault": array_of("BOOL", [bool(s["fault"]) for s in scans]),
        "writes": array_of("BOOL", [s["mv"] is not None for s in scans]),
        "mv": numbers([s["mv"] for s in scans], len(m.mv)),
        "mv_by_hand": numbers([s["set_mv"] for s in scans], len(m.mv)),
    }


def _finite(text: str) -> float:
    """A number of the kit; one that is not finite by its stand-in, which the program makes infinite."""
    value = float.fromhex(text)
    return value if np.isfinite(value) else -BEYOND if value < 0 else BEYOND
