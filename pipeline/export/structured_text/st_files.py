"""The folder of a controller in Structured Text: data types, step, guard, vectors, and all of them as PLCopen XML."""

from __future__ import annotations

import onnx

from loopwright.pipeline.export.plain_code.lowering import lowered
from loopwright.pipeline.export.plain_code.self_test import kit_in_c
from loopwright.pipeline.export.structured_text.array_types import with_named_arrays
from loopwright.pipeline.export.structured_text.elementary_functions import printed_function
from loopwright.pipeline.export.structured_text.guard_block import printed_guard, printed_operate_type
from loopwright.pipeline.export.structured_text.iec_names import comment, lreal
from loopwright.pipeline.export.structured_text.plcopen import plcopen_xml
from loopwright.pipeline.export.structured_text.scan_time import estimates, step_counts
from loopwright.pipeline.export.structured_text.step_block import StepBlock, printed_step_block
from loopwright.pipeline.export.structured_text.vectors_program import printed_vectors_program, steps_taken
from loopwright.serving.controller import Controller
from loopwright.serving.manifest import Manifest
from loopwright.serving.version import __version__


def st_folder(controller: Controller, name: str) -> tuple[dict[str, str], list[str]]:
    """The text of each file by its name, and estimates of the duration of a step.

    ExportError where the graph has an operator without plain statements, or where the statements, run over the
    conformance kit, part from the controller.
    """
    program, m = lowered(onnx.load(controller.path)), controller.manifest
    kit = kit_in_c(controller, program)
    step = printed_step_block(program, name)
    functions = [printed_function(name, f) for f in step.own_functions]
    operate = printed_operate_type(m, name)
    types, (law, vectors, *guard) = with_named_arrays(
        name, [step.text, printed_vectors_program(m, name, step, kit), *printed_guard(m, name, step)]
    )
    types += [operate] if operate else []
    durations = estimates(step.program)
    head = (
        f"Law {m.law} of {m.case}, made of {controller.path.name} by loopwright {__version__}.\n"
        f"   sha256 of that file: {controller.sha256}"
    )
    first = f"(* {comment(head.splitlines()[0])}\n{head.splitlines()[1]}"
    about = "\n".join([first, "", *_about(m, step), *(f"   {line}" for line in durations), "*)\n"])
    taken = f"{first}\n\n   {len(steps_taken(kit))} of the kit's {len(kit.given['sp'])} steps, all its scans. *)\n"
    files = {
        f"{name}_types.st": "\n".join([f"{first} *)\n", *types]),
        f"{name}_step.st": "\n".join([about, *functions, law]),
        f"{name}_guard.st": "\n".join([f"{first} *)\n", *guard]),
        f"{name}_test.st": "\n".join([taken, vectors]),
    }
    step_text = law.replace("FUNCTION_BLOCK", f"{about}FUNCTION_BLOCK", 1)
    units = [*types, *functions, step_text, *guard, vectors]
    files[f"{name}.xml"] = plcopen_xml(name, __version__, units)
    return files, durations


def _about(m: Manifest, step: StepBlock) -> list[str]:
    """Lines of the head: signals, memory, operations."""
    lines = [
        f"   One call a period of {lreal(m.period_s)} s, in a task of its own. Values are in engineering units. The",
        "   step checks nothing; the guard does. It needs LREAL as IEEE 754 doubles, and SQRT.",
        "",
    ]
    for kind in ("sp", "pv", "dv", "mv"):
        lines += [
            f"   {kind}[{k}] {comment(s.name)} [{comment(s.unit)}], {lreal(s.low)} to {lreal(s.high)}"
            for k, s in enumerate(m.signals(kind))
        ]
    lines += [f"   info[{k}] {comment(text)}" for k, text in enumerate(m.info)]
    lines += [f"   operate[{k}] {comment(e.name)} {comment(e.unit)}".rstrip() for k, e in enumerate(m.operate)]
    counts = step_counts(step.program)
    return [
        *lines,
        "",
        f"   Bytes of work memory in the instance: {step.work_bytes}; of constants: {step.table_bytes}.",
        f"   A step: {step.program.operations} rounds of loops, at most {counts.operations} operations of LREAL and",
        f"   {counts.accesses} entries read or written. Estimates from published figures, not measured:",
    ]
