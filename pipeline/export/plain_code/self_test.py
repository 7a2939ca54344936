"""The conformance kit in C: the steps to the bit, and the scans of the loop."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from loopwright.pipeline.errors import ExportError
from loopwright.pipeline.export.plain_code.interpreter import run
from loopwright.pipeline.export.plain_code.printed_functions import number
from loopwright.pipeline.export.plain_code.statements import OUTPUT, Floats, PlainProgram
from loopwright.serving.conformance.kit import CHAIN_TOLERANCE, KIT_TOLERANCE, read_all, vectors_of
from loopwright.serving.controller import Controller
from loopwright.serving.modes import Mode

FNV_BEGIN, FNV_PRIME = 14695981039346656037, 1099511628211  # of the 64-bit hash FNV-1a
WORD = (1 << 64) - 1  # the bits of the hash
MODES = (Mode.MANUAL, Mode.AUTO, Mode.HOLD, Mode.SHADOW)  # by their numbers in C and Structured Text


@dataclass(frozen=True, slots=True)
class KitInC:
    """The kit of a file: steps that are not refused (steps, n), given and as the statements answer; and its scans.

    ``worst`` is the largest difference between statements and controller, a share of an entry's scale.
    """

    given: Mapping[str, Floats]
    ours: Mapping[str, Floats]
    worst: float
    loop: Mapping[str, Any]
    scans: Sequence[Mapping[str, Any]]


def kit_in_c(controller: Controller, program: PlainProgram) -> KitInC:
    """The kit, its steps run by the statements.

    ExportError where they part from the controller by more than ``KIT_TOLERANCE`` of an entry's scale.
    """
    vectors = vectors_of(controller)
    scale = read_all(vectors["scale"], "scale")
    rows = [row for row in vectors["steps"] if not row.get("refused")]
    given, gives = ([read_all(row[key], key) for row in rows] for key in ("given", "gives"))
    inputs = {n: np.array([row[n] for row in given]) for n in program.inputs}
    ours = {n.removeprefix(OUTPUT): v for n, v in run(program, **inputs).items()}
    worst = max(float((np.abs(v - [row[n] for row in gives]) / scale[n]).max()) for n, v in ours.items() if v.size)
    if not worst <= KIT_TOLERANCE:
        raise ExportError(
            f"the plain statements part from {controller.path.name} by {worst:.1e} of an entry's scale; at most "
            f"{KIT_TOLERANCE:g} is allowed, so nothing is written"
        )
    return KitInC(inputs, ours, worst, vectors["loop"], vectors["scans"])


def hashed(rows: Floats) -> int:
    """FNV-1a over the bytes of all entries, each double from its lowest byte on."""
    found = FNV_BEGIN
    for byte in rows.astype("<f8").tobytes():
        found = ((found ^ byte) * FNV_PRIME) & WORD
    return found


def printed_self_test(head: str, name: str, program: PlainProgram, kit: KitInC) -> str:
    """``NAME_selftest.c``: exits with 0 where all bits of the steps are the same and the loop does as the kit says."""
    inputs = list(program.inputs.items())
    outputs = [(n.removeprefix(OUTPUT), count) for n, count in program.outputs.items() if count]
    given, wanted = (np.hstack([of[n] for n, _ in names]) for of, names in ((kit.given, inputs), (kit.ours, outputs)))
    starts, ends = (np.cumsum([0, *(count for _, count in names)]) for names in (inputs, outputs))
    call = ", ".join([f"GIVEN[k] + {i}" for i in starts[:-1]] + [f"got + {i}" for i in ends[:-1]])
    return _TEXT.format(
        head=head,
        lower=name,
        upper=name.upper(),
        steps=len(given),
        entries=int(ends[-1]),
        hash=hashed(wanted),
        begin=FNV_BEGIN,
        prime=FNV_PRIME,
        given=_matrix("GIVEN", given),
        wanted=_matrix("WANTED", wanted),
        call=call,
        sp=", ".join(map(number, read_all({"sp": kit.loop["sp"]}, "loop")["sp"])) or "0.0",
        recover_after=int(kit.loop["recover_after"]),
        max_gap=number(float(kit.loop["max_gap"])),
        tolerance=number(CHAIN_TOLERANCE),
        n_scans=len(kit.scans),
        scans=",\n".join(map(_scan, kit.scans)),
    )


def _scan(row: Mapping[str, Any]) -> str:
    sample = row["sample"] or {"age_s": "0x0p0"}
    read = {n: sample.get(n) for n in ("pv", "dv", "mv_applied")}
    lists = ", ".join(map(_list, read.values()))
    mode = MODES.index(Mode(row["set_mode"])) if row["set_mode"] else -1
    sent = f"{int(row['set_mv'] is not None)}, {_list(row['set_mv'])}"
    missed = number(float(row["missed"]))
    before = f"{mode}, {sent}, {int(row['unwritten'])}, {missed}, {int(row['sample'] is not None)}"
    inputs = f"{{{lists}, {int(bool(read['mv_applied']))}, {_any(sample['age_s'])}}}"
    after = f"{MODES.index(Mode(row['mode']))}, {int(row['fault'])}, {int(row['mv'] is not None)}, {_list(row['mv'])}"
    return f"    {{{before}, {inputs}, {after}}} /* {row['what'].replace('*/', '* /')} */"


def _list(texts: Sequence[str] | None) -> str:
    """Numbers of the kit; a zero stands for none."""
    return "{" + (", ".join(map(_any, texts or ())) or "0.0") + "}"


def _any(text: str) -> str:
    """A number of the kit, which need not be finite."""
    value = float.fromhex(text)
    if np.isnan(value):
        return "NO_NUMBER"
    return number(value) if np.isfinite(value) else "INFINITE" if value > 0 else "-INFINITE"


def _matrix(name: str, rows: Floats) -> str:
    lines = ",\n".join("    {" + ", ".join(number(v) for v in row) + "}" for row in rows)
    return f"static const double {name}[{len(rows)}][{len(rows[0])}] = {{\n{lines}\n}};"


_TEXT = """/* {head}

   Runs the conformance kit: whether this processor and compiler give the same bits in each step, and whether the loop
   does in each scan what it must. Exits with 0 if so. */

#include <inttypes.h>
#include <math.h>
#include <stdio.h>
#include <string.h>

#include "{lower}_guard.h"

enum {{ STEPS = {steps}, ENTRIES = {entries}, SCANS = {n_scans} }};
static const uint64_t SAME_BITS = UINT64_C({hash});

{given}

{wanted}

#define NO_NUMBER 1.25e308
#define INFINITE 1.5e308

/* Before a scan: the mode that the operator sets, or -1; whether and where the operator sends the MV; whether the last
   command did not arrive; periods without a scan; whether there is a sample. After it: mode, whether there is a fault,
   whether the MV is written, the MV. */
static const struct {{
    int set_mode;
    int sends;
    double sent[{upper}_N_MV];
    int unwritten;
    double missed;
    int is_read;
    {lower}_sample sample;
    int mode;
    int fault;
    int writes;
    double mv[{upper}_N_MV];
}} SCAN[SCANS] = {{
{scans}
}};

static int steps_differ(void)
{{
    uint64_t hash = UINT64_C({begin});
    int parted = 0;
    for (int k = 0; k < STEPS; ++k) {{
        double got[ENTRIES];
        {lower}_step({call});
        for (int i = 0; i < ENTRIES; ++i) {{
            uint64_t bits;
            memcpy(&bits, &got[i], sizeof bits);
            for (int b = 0; b < 8; ++b) {{
                hash = (hash ^ ((bits >> (8 * b)) & 255u)) * UINT64_C({prime});
            }}
            if (!(got[i] >= WANTED[k][i] && got[i] <= WANTED[k][i])) {{
                ++parted;
                printf("step %d, entry %d: %.17g instead of %.17g\\n", k, i, got[i], WANTED[k][i]);
            }}
        }}
    }}
    printf("%d steps, %d entries differ: %s\\n", STEPS, parted, hash == SAME_BITS ? "the same bits" : "other bits");
    return hash != SAME_BITS;
}}

/* Not every compiler has NAN among its constants: these two stand for NaN and infinity in the table. */
static double kit_number(double x)
{{
    static const volatile double none = 0.0;
    if (x >= INFINITE || x <= -INFINITE) {{
        return x / none;
    }}
    return x >= NO_NUMBER ? none / none : x;
}}

static int scans_differ(void)
{{
    static {lower}_loop l;
    static const double sp[] = {{{sp}}};
    int wrong = 0;
    {lower}_begin(&l, {upper}_AUTO, {recover_after});
    l.max_gap = {max_gap};
    wrong += !{lower}_set_sp(&l, sp);
    for (int k = 0; k < SCANS; ++k) {{
        {lower}_sample s = SCAN[k].sample;
        int as_wanted;
        for (int i = 0; i < {upper}_N_PV; ++i) {{
            s.pv[i] = kit_number(s.pv[i]);
        }}
        for (int i = 0; i < {upper}_N_DV; ++i) {{
            s.dv[i] = kit_number(s.dv[i]);
        }}
        for (int i = 0; i < {upper}_N_MV; ++i) {{
            s.mv_applied[i] = kit_number(s.mv_applied[i]);
        }}
        s.age_s = kit_number(s.age_s);
        if (SCAN[k].set_mode >= 0) {{
            {lower}_set_mode(&l, ({lower}_mode)SCAN[k].set_mode);
        }}
        if (SCAN[k].sends) {{
            (void){lower}_set_mv(&l, SCAN[k].sent); /* it may have to be refused */
        }}
        if (SCAN[k].unwritten) {{
            {lower}_unwritten(&l);
        }}
        if (SCAN[k].missed > 0.0) {{
            {lower}_gap(&l, SCAN[k].missed);
        }}
        as_wanted = {lower}_scan(&l, SCAN[k].is_read ? &s : NULL) == SCAN[k].writes;
        as_wanted = as_wanted && (int)l.mode == SCAN[k].mode && (l.why != {upper}_NONE) == SCAN[k].fault;
        for (int i = 0; i < {upper}_N_MV && SCAN[k].writes; ++i) {{
            const double range = {upper}_MV_HIGH[i] - {upper}_MV_LOW[i];
            as_wanted = as_wanted && fabs(l.mv[i] - SCAN[k].mv[i]) <= {tolerance} * range;
        }}
        if (!as_wanted) {{
            ++wrong;
            printf("scan %d: mode %d, fault %d, mv %.17g\\n", k, (int)l.mode, (int)l.why, l.mv[0]);
        }}
    }}
    printf("%d scans, %d wrong\\n", SCANS, wrong);
    return wrong > 0;
}}

int main(void)
{{
    const int steps = steps_differ();
    return scans_differ() || steps;
}}
"""
