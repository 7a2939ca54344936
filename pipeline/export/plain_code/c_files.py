"""The folder of a controller in plain C: step, header, guard, self-test and what builds them."""

from __future__ import annotations

import re
from importlib.resources import files

import onnx

from loopwright.pipeline.errors import ExportError
from loopwright.pipeline.export.plain_code.c_header import printed_header
from loopwright.pipeline.export.plain_code.c_text import PrintedStep, printed_step
from loopwright.pipeline.export.plain_code.lowering import lowered
from loopwright.pipeline.export.plain_code.self_test import kit_in_c, printed_self_test
from loopwright.pipeline.export.plain_code.statements import OUTPUT, PlainProgram
from loopwright.serving.controller import Controller
from loopwright.serving.manifest import Manifest
from loopwright.serving.version import __version__

# Words of C and C++ that no name may be, and that a case and a law could give.
RESERVED = frozenset({"auto", "case", "class", "default", "double", "for", "if", "new", "register", "signed", "switch"})
# What stands for each input and output of a step in the guard.
IN_GUARD = {
    "sp": "l->sp", "pv": "pv", "dv": "dv", "mv_applied": "l->applied", "state": "l->state", "operate": "operate",
    "fresh": "fresh", "ahead": "l->ahead", "mv": "mv", "state_next": "next", "info": "info",
}  # fmt: skip


def c_name(manifest: Manifest) -> str:
    """A name for C and C++ of the case and the law."""
    found = re.sub(r"\W+", "_", f"{manifest.case}_{manifest.law}", flags=re.ASCII).strip("_").lower()
    return f"law_{found}" if not found or found[0].isdigit() else found


def require_c_name(name: str) -> str:
    """``name``; ExportError where it is none of C and C++."""
    if not re.fullmatch(r"[a-z][a-z0-9_]*", name) or name in RESERVED:
        raise ExportError(f"{name!r} is no name for C here; take small letters, digits and _, a letter first")
    return name


def c_folder(controller: Controller, name: str) -> dict[str, str]:
    """The text of each file by its name.

    ExportError where the graph has an operator without plain statements, or where the statements, run over the
    conformance kit, part from the controller.
    """
    program, head = lowered(onnx.load(controller.path)), _head(controller)
    call = ", ".join(IN_GUARD[n] for n in arguments_of(program))
    guards = {f"{name}_guard.{end}": _of_template(f"guard.{end}", name, head, call) for end in ("h", "c")}
    return {
        **c_step(controller, program, name),
        **guards,
        f"{name}_selftest.c": printed_self_test(head, name, program, kit_in_c(controller, program)),
        "Makefile": _MAKEFILE.replace("LAW", name),
        "CMakeLists.txt": _CMAKE.replace("LAW", name),
    }


def c_step(controller: Controller, program: PlainProgram, name: str) -> dict[str, str]:
    """The text of ``NAME.h`` and ``NAME.c``: the step alone, of the ``program`` that its graph was lowered to."""
    step, head = printed_step(program, name), _head(controller)
    header = printed_header(head, controller.manifest, controller.sha256, name, step, arguments_of(program))
    return {f"{name}.h": header, f"{name}.c": _source(head, name, step)}


def _head(controller: Controller) -> str:
    m = controller.manifest
    return (
        f"Law {m.law} of {m.case}, made of {controller.path.name} by loopwright {__version__}.\n"
        f"   sha256 of that file: {controller.sha256}"
    ).replace("*/", "* /")


def arguments_of(program: PlainProgram) -> list[str]:
    """The names of what a step in C is given and gives, in its order: inputs, then mv, state_next and info."""
    return [*program.inputs, *(n.removeprefix(OUTPUT) for n, count in program.outputs.items() if count)]


def _of_template(file: str, name: str, head: str, call: str) -> str:
    text = files("loopwright.pipeline.export.plain_code").joinpath(file).read_text(encoding="utf-8")
    text = text.replace("HEAD", head, 1).replace("    STEP\n", f"    {name}_step({call});\n")
    return text.replace("UPPER_", f"{name.upper()}_").replace("lower_", f"{name}_").replace("lower.h", f"{name}.h")


def _source(head: str, name: str, step: PrintedStep) -> str:
    return f"""/* {head} */

#include <float.h>
#include <math.h>

#include "{name}.h"

#if defined(FLT_EVAL_METHOD) && FLT_EVAL_METHOD != 0
#error "doubles must be computed as doubles: on x86 of 32 bits compile with -msse2 -mfpmath=sse"
#endif
#if defined(__FAST_MATH__)
#error "compile without -ffast-math: it changes the order of sums"
#endif
#if defined(__clang__)
#pragma STDC FP_CONTRACT OFF
#endif

{step.definitions}"""


_MAKEFILE = """# make check: the self-test with this compiler, on this processor.
CFLAGS ?= -std=c99 -O2 -Wall -Wextra -Wconversion
# Without this a compiler may round a product and a sum once together: other last digits.
override CFLAGS += -ffp-contract=off

all: LAW.o LAW_guard.o

LAW.o: LAW.c LAW.h
\t$(CC) $(CFLAGS) -c LAW.c -o $@

LAW_guard.o: LAW_guard.c LAW_guard.h LAW.h
\t$(CC) $(CFLAGS) -c LAW_guard.c -o $@

LAW_selftest: LAW_selftest.c LAW.o LAW_guard.o
\t$(CC) $(CFLAGS) LAW_selftest.c LAW.o LAW_guard.o -lm -o $@

check: LAW_selftest
\t./LAW_selftest

clean:
\trm -f LAW.o LAW_guard.o LAW_selftest

.PHONY: all check clean
"""

_CMAKE = """cmake_minimum_required(VERSION 3.13)
project(LAW C)
set(CMAKE_C_STANDARD 99)
add_library(LAW STATIC LAW.c LAW_guard.c)
target_include_directories(LAW PUBLIC ${CMAKE_CURRENT_SOURCE_DIR})
if(NOT MSVC)
  target_compile_options(LAW PRIVATE -ffp-contract=off)
  target_link_libraries(LAW PUBLIC m)
endif()
add_executable(LAW_selftest LAW_selftest.c)
target_link_libraries(LAW_selftest PRIVATE LAW)
enable_testing()
add_test(NAME LAW_selftest COMMAND LAW_selftest)
"""
