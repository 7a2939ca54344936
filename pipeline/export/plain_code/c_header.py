"""The header of a controller in plain C: what the manifest says, as constants."""

from __future__ import annotations

from collections.abc import Sequence

from loopwright.pipeline.export.plain_code.c_text import PrintedStep
from loopwright.pipeline.export.plain_code.printed_functions import number
from loopwright.serving.bridging import BRIDGE_PERIODS
from loopwright.serving.manifest import INPUTS, SWITCHES, Manifest, Signal

OUTPUTS = ("mv", "state_next", "info")


def printed_header(head: str, m: Manifest, sha256: str, name: str, step: PrintedStep, arguments: Sequence[str]) -> str:
    """``NAME.h``: sizes, ranges, entries of ``operate``, what a step takes, and its declaration; C99 and C++17.

    ``arguments`` are the names of what a step is given and gives, in its order.
    """
    by_place = [f"(in)[{INPUTS.index(n)}]" if n in INPUTS else f"(out)[{OUTPUTS.index(n)}]" for n in arguments]
    big = name.upper()
    n_ahead = 0 if m.ahead is None else m.ahead.size
    sizes = {n: len(getattr(m, n)) for n in ("sp", "pv", "dv", "mv", "info", "operate")}
    sizes |= {"state": m.n_state, "ahead": n_ahead}
    numbers = [f"#define {big}_N_{n.upper()} {count}" for n, count in sizes.items()]
    uses = [f"#define {big}_USES_{n.upper()} {int(n in m.inputs)}" for n in ("dv", "fresh")]
    tables = [_signals(big, n, getattr(m, n)) for n in ("sp", "pv", "dv", "mv") if getattr(m, n)]
    if m.operate:
        tables.append(_operate(big, m))
    if m.ahead is not None:
        tables.append("/* ahead: set points, then measured disturbances, at each sample of the horizon */")
        ends = {"LOW": [s.low for s in m.ahead.signals], "HIGH": [s.high for s in m.ahead.signals]}
        tables += [_numbers(f"{big}_AHEAD_{end}", values) for end, values in ends.items()]
    info = [f"     info[{i}] {_words(text)}" for i, text in enumerate(m.info)]
    lines = [
        f"/* {head}",
        "",
        f"   One step a period of {number(m.period_s)} s:",
        "",
        f"     {step.declaration};",
        "",
        "   Values are in engineering units. A state of zeros says that there is no past: begin so, and after gaps.",
        "   Carry state_next to the next step, from an array of its own. mv_applied is what the plant received over",
        f"   the last period. The step checks nothing; {name}_guard.c does.",
        *info,
        "*/",
        f"#ifndef {big}_H",
        f"#define {big}_H",
        "",
        "#ifdef __cplusplus",
        'extern "C" {',
        "#endif",
        "",
        f'#define {big}_SHA256 "{sha256}"',
        f"#define {big}_PERIOD_S {number(m.period_s)}",
        f"#define {big}_BRIDGE_S {number(BRIDGE_PERIODS * m.period_s)} /* of a bad reading that is predicted */",
        *numbers,
        *uses,
        f"#define {big}_ROOM(n) ((n) > 0 ? (n) : 1) /* entries of an array that may have none */",
        f"#define {big}_STACK_BYTES {step.work_bytes} /* of the step's own numbers */",
        f"#define {big}_TABLE_BYTES {step.table_bytes} /* of its constants */",
        f"#define {big}_OPERATIONS {step.operations} /* a step, whatever it is given */",
        "",
        *tables,
        "",
        f"{step.declaration};",
        "",
        "/* The same for a host of any law: in has sp, pv, dv, mv_applied, state, operate, fresh, ahead, out has mv,",
        "   state_next, info; READS names those of in that this law reads. */",
        f"#define {big}_CALL(in, out) {name}_step({', '.join(by_place)})",
        f'#define {big}_READS "{" ".join(n for n in arguments if n in INPUTS)}"',
        "",
        "#ifdef __cplusplus",
        "}",
        "#endif",
        "",
        "#endif",
    ]
    return "\n".join(lines) + "\n"


def _signals(big: str, kind: str, signals: Sequence[Signal]) -> str:
    columns = {"LOW": [s.low for s in signals], "HIGH": [s.high for s in signals]}
    if kind in ("sp", "mv"):
        columns["MIDDLE"] = [s.middle for s in signals]
    if kind == "mv":
        columns["MAX_MOVE"] = [0.0 if s.max_move is None or s.values else s.max_move for s in signals]
    words = ", ".join(f"{_words(s.name)} [{_words(s.unit)}]" for s in signals)
    lines = [f"/* {kind}: {words} */"]
    lines += [_numbers(f"{big}_{kind.upper()}_{what}", values) for what, values in columns.items()]
    if kind == "mv":
        values = [v for s in signals for v in s.values or ()]
        first = [0]
        for s in signals:
            first.append(first[-1] + len(s.values or ()))
        lines += [
            "/* values of a discrete MV k: FIRST[k] to before FIRST[k + 1]; largest change a period 0: no limit */",
            _numbers(f"{big}_MV_VALUES", values or [0.0]),
            _integers(f"{big}_MV_FIRST", first),
        ]
    return "\n".join(lines)


def places_above(m: Manifest) -> list[int]:
    """By entry of ``operate``: the place of the high end that a low end must not exceed, of any other its own."""
    names = [e.name for e in m.operate]
    return [names.index(f"{e.signal}.high") if e.what == "low" else i for i, e in enumerate(m.operate)]


def _operate(big: str, m: Manifest) -> str:
    """Entries of ``operate``, in their order."""
    uses = {e.signal: i for i, e in enumerate(m.operate) if e.group == "cv" and e.what == "use"}
    use = [uses.get(s.name, -1) for s in m.pv]
    words = "\n".join(f"   [{i}] {_words(e.name)} {_words(e.unit)}".rstrip() for i, e in enumerate(m.operate))
    return "\n".join(
        [
            f"/* operate:\n{words} */",
            _numbers(f"{big}_OPERATE_DEFAULT", [e.default for e in m.operate]),
            _numbers(f"{big}_OPERATE_LOW", [e.low for e in m.operate]),
            _numbers(f"{big}_OPERATE_HIGH", [e.high for e in m.operate]),
            "/* 0 or 1 alone; the entry that it must not exceed, or itself; where the use of a PV stands, or -1 */",
            _integers(f"{big}_OPERATE_SWITCH", [int(e.what in SWITCHES) for e in m.operate]),
            _integers(f"{big}_OPERATE_ABOVE", places_above(m)),
            _integers(f"{big}_USE_OF_PV", use),
        ]
    )


def _numbers(name: str, values: Sequence[float]) -> str:
    return f"static const double {name}[{len(values)}] = {{{', '.join(map(number, values))}}};"


def _integers(name: str, values: Sequence[int]) -> str:
    return f"static const int {name}[{len(values)}] = {{{', '.join(map(str, values))}}};"


def _words(text: str) -> str:
    """A text of a manifest, in a comment."""
    return text.replace("*/", "* /").replace("/*", "/ *").replace("\n", " ")
