"""A controller described for a person in plain text, and the time of its step on this machine."""

from __future__ import annotations

import json
import time
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from loopwright.serving.certificate import CERTIFICATE, certificate_of
from loopwright.serving.clock import MonotonicClock
from loopwright.serving.controller import Controller
from loopwright.serving.loop import WARM_LEAD_S
from loopwright.serving.manifest import SWITCHES, OperateEntry, Signal
from loopwright.serving.operating import unit_words
from loopwright.serving.trust import ending, judged, signer
from loopwright.serving.words import plain

SHOWN = {
    "scenarios",
    "units",
    "locked_up",
    "as_printed",
    "swings",
    "beyond_reach",
    "calmed",
    "operated",
    CERTIFICATE,
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
    lines[1:1] = [
        *first,
        *_swings(m.evidence),
        *_beyond_reach(m.evidence),
        *_calmed(m.evidence),
        *_doubtful(m.evidence),
    ]
    for title, name in (("set points", "sp"), ("process variables", "pv"), ("measured disturbances", "dv")):
        idle = " (this law does not take them)" * (name == "dv" and "dv" not in m.inputs)
        lines += _signals(title + idle, m.signals(name), m.period_s)
    lines += _signals("manipulated variables", m.mv, m.period_s)
    lines += _operate(m.operate if "operate" in m.inputs else (), m.period_s)
    outputs = ["mv"] + ["state_next"] * bool(m.n_state) + ["info"] * bool(m.info)
    lines += ["", f"inputs      {', '.join(m.inputs)}", f"outputs     {', '.join(outputs)}"]
    lines += [f"state       {m.n_state} numbers, all zero: no past", f"info        {', '.join(m.info) or '-'}"]
    lines += ["", "provenance"] + (_tree(m.provenance) or ["  -"])
    lines += _certificate(controller)
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


def _certificate(controller: Controller) -> list[str]:
    """The certificate's sentence and what it rests on; nothing without one."""
    read = certificate_of(controller.manifest, controller.law_sha256)
    if read.wrong:
        return ["", f"certificate: NOT TO BE BELIEVED, {read.wrong}"]
    return ["", "certificate", *(f"  {line}" for line in read.lines)] if read.certificate else []


def _signals(title: str, signals: tuple[Signal, ...], period_s: float) -> list[str]:
    if not signals:
        return []
    width = max(len(s.name) for s in signals)
    rows = []
    for s in signals:
        allowed = f"{s.low:g} .. {s.high:g}" if s.values is None else f"one of {', '.join(f'{v:g}' for v in s.values)}"
        unit = "" if s.unit == "-" else f" {s.unit}"
        moves = "" if s.max_move is None else f", moves at most {s.max_move:g}{unit} a period ({period_s:g} s)"
        rows.append(f"  {s.name:<{width}}  {allowed}{unit}{moves}")
    return ["", title, *rows]


def _operate(entries: tuple[OperateEntry, ...], period_s: float) -> list[str]:
    """A table of what operators may change: name, default, engineered range, unit."""
    if not entries:
        return []
    rows = [("name", "default", "allowed", "unit")]
    for e in entries:
        switched = e.what in SWITCHES and e.low < e.high
        rows.append(
            (e.name, f"{e.default:g}", "0 or 1" if switched else f"{e.low:g} .. {e.high:g}", unit_words(e, period_s))
        )
    name, default, allowed, _ = (max(map(len, column)) for column in zip(*rows, strict=True))
    lines = [f"  {n:<{name}}  {d:>{default}}  {a:<{allowed}}  {u}".rstrip() for n, d, a, u in rows]
    return ["", "what operators may change (operate)", *lines]


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


def _calmed(evidence: dict[str, Any]) -> list[str]:
    """Why the numbers are calmer than those that the tuning found; nothing where they are these."""
    why = evidence.get("calmed")
    return [f"  calmer numbers than the tuning found, with which it {why}"] if isinstance(why, str) and why else []


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
    operated = evidence.get("operated")
    lines += _operated(operated) if isinstance(operated, dict) else []
    return lines + _tree({k: v for k, v in evidence.items() if rows is not evidence and k not in SHOWN})


def _operated(tests: dict[str, Any]) -> list[str]:
    """Tests in which operators change ranges, MVs in use, costs and ranks, a line each."""
    lines = []
    for test, row in tests.items():
        known = {k: v for k, v in row.items() if isinstance(v, int | float)} if isinstance(row, dict) else {}
        lines.append(f"  {test}: " + ", ".join(f"{name} {value:.4g}" for name, value in known.items()))
    return ["  operators' changes (shares of time, of the gain, of the violation, of ranges)", *lines] if lines else []


def _tree(values: dict[str, Any], indent: int = 2) -> list[str]:
    lines = []
    for key, value in values.items():
        if isinstance(value, dict):
            lines += [f"{' ' * indent}{key}", *_tree(value, indent + 2)]
        else:
            text = ", ".join(map(str, value)) if isinstance(value, list) else str(value)
            lines.append(f"{' ' * indent}{key}: {text}")
    return lines


WARM_UP = 1_000  # steps before the first that counts
FEEDS = 1_000  # different inputs, taken in turn: more would only fill the caches
WAIT_US = 20.0  # without the processor: a step that lost it for longer was disturbed
# Some systems count a thread's time in ticks, which tells nothing of a step.
TELLS = time.get_clock_info("thread_time").resolution < 1e-6


@dataclass(frozen=True, slots=True)
class Timing:
    """Percentiles of a step's duration [us], of all steps and of those that nothing disturbed.

    ``waited`` is the share [%] of steps in which the thread was without a processor for more than 20 us: another
    program had it, and the controller can do nothing about that. ``alone`` is the 99.9 % quantile of the others. Both
    are NaN where the system does not tell.
    """

    label: str
    p50: float
    p99: float
    p999: float
    waited: float
    alone: float

    @classmethod
    def of(cls, label: str, wall_ns: NDArray[np.float64], processor_ns: NDArray[np.float64]) -> Timing:
        """Percentiles of measured durations, and of the processor's time that each step had."""
        took = wall_ns / 1e3
        p50, p99, p999 = np.percentile(took, [50, 99, 99.9])
        free = took - processor_ns / 1e3 <= WAIT_US
        waited, alone = 100 * float(1 - free.mean()), np.percentile(took[free], 99.9) if free.any() else np.nan
        if not TELLS:
            waited = alone = np.nan
        return cls(label, float(p50), float(p99), float(p999), waited, float(alone))


def bench(
    controller: Controller, *, steps: int = 20_000, loop_steps: int = 1_000, period_s: float = 0.01
) -> tuple[Timing, ...]:
    """Step times hot, in a ``period_s`` loop as the control loop runs it, and there without the warm step.

    Inputs move a little from step to step around the middle of their ranges. The first steps do not count.
    """
    m, rng = controller.manifest, np.random.default_rng(0)
    middle = {n: np.array([s.middle for s in m.signals(n)]) for n in ("sp", "pv", "dv", "mv_applied")}
    # A discrete signal has no values a little away from another.
    span = {n: np.array([0.0 if s.values else s.high - s.low for s in m.signals(n)]) for n in middle}
    feeds = [{n: middle[n] + 0.01 * span[n] * rng.uniform(-1, 1, len(span[n])) for n in middle} for _ in range(FEEDS)]

    def run(label: str, n: int, wait: float | None, warm: bool) -> Timing:
        clock, state, took, had = MonotonicClock(), controller.cold_state(), np.ones(n), np.ones(n)
        start = clock.now() + 0.01
        for k in range(n):
            if wait is not None:
                if warm:
                    clock.sleep_until(start + k * wait - WARM_LEAD_S)
                    controller.warm()
                clock.sleep_until(start + k * wait)
            inputs = feeds[k % FEEDS]
            own = time.thread_time_ns()
            before = time.perf_counter_ns()
            state = controller.step(**inputs, state=state).state
            took[k] = time.perf_counter_ns() - before
            had[k] = time.thread_time_ns() - own
        return Timing.of(label, took, had)

    run("", min(steps, WARM_UP), None, False)
    every = f"every {period_s * 1e3:g} ms"
    return (
        run("hot", steps, None, False),
        run(f"{every}, warmed", loop_steps, period_s, True),
        run(f"{every}, cold", loop_steps, period_s, False),
    )


def table(timings: tuple[Timing, ...]) -> str:
    """The timings as plain text, with what disturbed them."""
    rows = [f"{'step [us]':<22}{'p50':>9}{'p99':>9}{'p99.9':>9}{'waited':>9}{'p99.9 of the others':>21}"]
    for t in timings:
        alone = f"{t.alone:.1f} = {t.alone / t.p50:.1f} p50"
        rows.append(f"{t.label:<22}{t.p50:>9.1f}{t.p99:>9.1f}{t.p999:>9.1f}{t.waited:>7.2f} %{alone:>21}")
    rows.append(f"waited: steps that were without a processor for more than {WAIT_US:g} us, as other programs had it")
    return "\n".join(rows)
