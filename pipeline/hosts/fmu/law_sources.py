"""The sources of an FMU: the plain C of one controller with its names and ranges, or the host on onnxruntime."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
import onnx

from loopwright.pipeline.export.plain_code.c_files import c_folder
from loopwright.pipeline.export.plain_code.c_header import places_above
from loopwright.pipeline.export.plain_code.interpreter import run
from loopwright.pipeline.export.plain_code.lowering import lowered
from loopwright.pipeline.export.plain_code.printed_functions import number
from loopwright.pipeline.export.plain_code.statements import OUTPUT
from loopwright.pipeline.hosts.fmu.compiling import HOSTS, SOURCES, Toolchain
from loopwright.serving.conformance.steps import OUTPUTS, StepResult, answered
from loopwright.serving.controller import Controller, Step
from loopwright.serving.manifest import INPUTS, SWITCHES, Manifest, Signal

LAW = "law"  # the name of the step in C, of every FMU: its library shows the functions of FMI alone


def sources_of(controller: Controller, fmi: int, tools: Toolchain) -> dict[str, str]:
    """The text of each file of ``sources``, by its name.

    ExportError where the law has an operator without plain statements, and no onnxruntime computes it.
    """
    taken = [HOSTS / "c" / "controller.c", SOURCES / "instance.c", *SOURCES.glob(f"fmi{fmi}*.c")]
    graph = SOURCES / ("plain_controller.c" if tools.library is None else "onnxruntime_controller.c")
    found = {path.name: path.read_text(encoding="utf-8") for path in taken}
    found["law_controller.c"] = graph.read_text(encoding="utf-8")
    if tools.library is not None:
        return found | {"host.c": (HOSTS / "c" / "host.c").read_text(encoding="utf-8")}
    plain = c_folder(controller, LAW)
    return found | {name: plain[name] for name in (f"{LAW}.c", f"{LAW}.h")} | {"law_signals.h": _signals(controller)}


def plain_answers(controller: Controller) -> list[StepResult]:
    """The kit's steps, each from the state of the kit, as the plain statements answer them."""
    answers, program = answered(controller), lowered(onnx.load(controller.path))
    taken = [answer for answer in answers if answer.step is not None]
    given = {
        name: np.array([a.state if name == "state" else a.given.inputs[name] for a in taken]) for name in program.inputs
    }
    ours = {name.removeprefix(OUTPUT): rows for name, rows in run(program, **given).items()}
    none = np.zeros((len(taken), 0))
    rows = iter(zip(*(ours.get(name, none) for name in OUTPUTS), strict=True))
    return [a if a.step is None else StepResult(a.given, a.state, Step(*next(rows))) for a in answers]


def _signals(controller: Controller) -> str:
    """``law_signals.h``: names, units and ranges as ``controller.c`` takes them."""
    m = controller.manifest
    uses = ", ".join(str(name in m.inputs).lower() for name in INPUTS)
    lines = [
        f"/* Names, units and ranges of the law whose sha256 is {controller.sha256}. */",
        f"static const bool LAW_USES[INPUTS] = {{{uses}}};",
        "",
    ]
    for kind in ("sp", "pv", "dv", "mv"):
        lines += _table(kind, getattr(m, kind))
    lines += _operate(m)
    ahead = () if m.ahead is None else m.ahead.signals
    for name, ends in (("LOW", [s.low for s in ahead]), ("HIGH", [s.high for s in ahead])):
        numbers = ", ".join(map(number, ends)) or "0.0"
        lines.append(f"static const double AHEAD_{name}[LAW_ROOM({len(ahead)})] = {{{numbers}}};")
    return "\n".join(lines) + "\n"


def _table(kind: str, signals: Sequence[Signal]) -> Iterator[str]:
    big, rows = kind.upper(), []
    for k, s in enumerate(signals):
        values = f"{big}_{k}_VALUES" if s.values else "NULL"
        if s.values:
            yield f"static const double {values}[] = {{{', '.join(map(number, s.values))}}};"
        move = "INFINITY" if kind != "mv" or s.max_move is None or s.values else number(s.max_move)
        words = f"{_text(s.name)}, {_text(s.unit)}, {number(s.low)}, {number(s.high)}"
        rows.append(f"  {{{words}, {values}, {len(s.values or ())}, {move}}}")
    yield f"static const Signal {big}_SIGNALS[LAW_ROOM({len(signals)})] = {{"
    yield ",\n".join(rows) or '  {"", "", 0.0, 0.0, NULL, 0, 0.0}'
    yield "};"


def _operate(m: Manifest) -> Iterator[str]:
    yield f"static const Operate OPERATE_ENTRIES[LAW_ROOM({len(m.operate)})] = {{"
    rows = [
        f"  {{{_text(e.name)}, {_text(e.unit)}, {number(e.default)}, {number(e.low)}, {number(e.high)}, "
        f"{str(e.what in SWITCHES).lower()}, {str(e.group == 'cv').lower()}, {place}}}"
        for e, place in zip(m.operate, places_above(m), strict=True)
    ]
    yield ",\n".join(rows) or '  {"", "", 0.0, 0.0, 0.0, false, false, 0}'
    yield "};"


def _text(words: str) -> str:
    """A string of C; what is no plain letter or mark stands as its bytes."""
    plain = (chr(b) if 32 <= b < 127 and chr(b) not in '"\\?' else f"\\{b:03o}" for b in words.encode())
    return f'"{"".join(plain)}"'
