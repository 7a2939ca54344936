"""``loopwright loop``: write a loop.toml, try it, run it, and make training data of its journal."""

from __future__ import annotations

import argparse
import getpass
import json
import logging
import os
import signal
import sys
import time
from collections.abc import Callable, Sequence
from contextlib import closing, suppress
from dataclasses import fields
from math import isnan
from pathlib import Path
from urllib.parse import urlsplit

import numpy as np
from numpy.typing import NDArray

from loopwright.serving.errors import EndpointError, LoopError
from loopwright.serving.first_steps import tried
from loopwright.serving.guard import Sample
from loopwright.serving.journal import JournalReader
from loopwright.serving.loop import Command, Mode
from loopwright.serving.manifest import Manifest, Signal
from loopwright.serving.operating import written
from loopwright.serving.preview.course_file import read_courses
from loopwright.serving.station.control import ask
from loopwright.serving.station.journal_export import export, happened, journal_of, lines, tag_table, write_csv
from loopwright.serving.station.requests import TRIAL
from loopwright.serving.station.settings import Settings, template
from loopwright.serving.trust import Controller, ending, judged
from loopwright.serving.words import plain

SETTINGS = Path("loop.toml")
OWN_ADDRESSES = frozenset({"localhost", "127.0.0.1", "::1"})
JOURNAL_LOST = 3  # exit status of a loop whose journal lacks scans or events


def options(parser: argparse.ArgumentParser) -> None:
    """Add the command's arguments."""
    commands = parser.add_subparsers(dest="action", metavar="ACTION", required=True)
    init = commands.add_parser("init", help="write a commented loop.toml for a controller, and a certificate")
    init.add_argument("file", metavar="CONTROLLER", type=Path, help="a controller's .onnx file")
    init.add_argument("--endpoint", default="opc.tcp://127.0.0.1:4840", help="the plant's server (%(default)s)")
    init.add_argument("--out", metavar="FILE", type=Path, default=SETTINGS, help="where it goes (%(default)s)")
    check = commands.add_parser("check", help="connect, read every node once, and say what would stop the loop")
    check.add_argument("file", metavar="LOOP.TOML", type=Path, nargs="?", default=SETTINGS, help="which (%(default)s)")
    run = commands.add_parser("run", help="run the loop until Ctrl-C")
    run.add_argument("file", metavar="LOOP.TOML", type=Path, nargs="?", default=SETTINGS, help="which (%(default)s)")
    run.add_argument("--scans", metavar="N", type=int, help="stop after so many")
    _asking(commands)
    out = commands.add_parser("export", help="write a journal's scans as a CSV that `loopwright new` reads")
    out.add_argument("file", metavar="JOURNAL", type=Path, help="the journal's file, also of a loop that runs")
    out.add_argument("--out", metavar="FILE", type=Path, help="where it goes (JOURNAL.csv)")
    out.add_argument("--replace", action="store_true", help="write over an earlier export")
    events = commands.add_parser("events", help="list what a journal says happened: when, who, what, and why")
    events.add_argument(
        "file", metavar="FILE", type=Path, nargs="?", default=SETTINGS, help="loop.toml or a journal (%(default)s)"
    )
    events.add_argument("--since", metavar="TIME", default="", help="from then on, as 2026-03-01T14:30 (UTC)")
    events.add_argument("--last", metavar="N", type=int, help="the last N only")
    events.add_argument("--csv", action="store_true", help="as CSV, for other tools")
    report = commands.add_parser("report", help="a week in plain words: time on control, and what bound the signals")
    report.add_argument(
        "file", metavar="FILE", type=Path, nargs="?", default=SETTINGS, help="loop.toml or a journal (%(default)s)"
    )
    report.add_argument("--weeks", metavar="N", type=int, default=1, help="the last N weeks (%(default)s)")


def _asking(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """The commands that steer a loop which runs."""
    swap = commands.add_parser("swap", help="try another controller beside the one in charge; then it takes over")
    which = swap.add_mutually_exclusive_group(required=True)
    which.add_argument("controller", metavar="CONTROLLER", type=Path, nargs="?", help="its .onnx file")
    which.add_argument("--back", action="store_true", help="the one that was replaced")
    which.add_argument("--keep", action="store_true", help="end the trial; the one in charge stays")
    swap.add_argument("--trial", metavar="N", type=int, default=TRIAL, help="good scans of trial (%(default)s)")
    mode = commands.add_parser("mode", help="change the mode")
    mode.add_argument("mode", metavar="MODE", type=str.upper, help=", ".join(Mode))
    for parser in (swap, mode):
        parser.add_argument(
            "--accept-unproven",
            action="store_true",
            help="let a controller into AUTO although its file does not prove it",
        )
    operate = "what operators may change of the law: ranges, uses, limits"
    for name, words in (("sp", "set points"), ("mv", "MVs by hand, in MANUAL or out of use"), ("operate", operate)):
        values = commands.add_parser(name, help=f"change {words}")
        values.add_argument("values", metavar="NAME=VALUE", nargs="+", help="of one or more signals, in their units")
    commands.choices["mv"].add_argument(
        "--take", action="store_true", help="take them out of the law's use first; it keeps the others"
    )
    course = commands.add_parser("course", help="give set points and forecasts of disturbances to come, or end them")
    known = course.add_mutually_exclusive_group(required=True)
    known.add_argument("courses", metavar="FILE.csv", type=Path, nargs="?", help="times, and values by signal")
    known.add_argument("--end", metavar="NAME", nargs="*", help="end the courses of these signals, or of all")
    course.add_argument(
        "--straight", metavar="NAME", action="append", default=[], help="a set point that runs straight to each value"
    )
    state = commands.add_parser("state", help="how the loop stands, as JSON")
    for parser in (swap, mode, *(commands.choices[name] for name in ("sp", "mv", "operate")), course, state):
        parser.add_argument("--loop", metavar="LOOP.TOML", type=Path, default=SETTINGS, help="which (%(default)s)")
        if parser is not state:
            parser.add_argument("--who", default=_user(), help="written down (%(default)s)")
            parser.add_argument("--reason", default="", help="written down")


def run(options: argparse.Namespace) -> int:
    """Do what was asked for; the exit status."""
    does = {"init": _init, "check": _check, "run": _run, "export": _export, "events": _events, "state": _state}
    does["report"] = _report
    return does.get(options.action, _ask)(options)


def _state(options: argparse.Namespace) -> int:
    journal = Settings.read(options.loop).journal.file
    about, state = (ask(journal, {"do": do}) for do in ("about", "state"))
    while about["card"]["sha256"] != state["sha256"]:  # another controller has taken over between the two
        about, state = (ask(journal, {"do": do}) for do in ("about", "state"))
    signals = {group: [s["name"] for s in about["signals"][group]] for group in ("sp", "pv", "mv", "dv")}
    names = {**signals, **dict.fromkeys(("applied", "law", "beside"), signals["mv"]), "info": about["info"]}
    names["operate"] = [e["name"] for e in about["operate"]]
    for group, of in names.items():
        if state.get(group) is not None:
            state[group] = dict(zip(of, state[group], strict=True))
    print(json.dumps(state, indent=2))
    return 0


def _ask(options: argparse.Namespace) -> int:
    settings = Settings.read(options.loop)
    do, value = options.action, None
    if do == "mode":
        value = options.mode
    elif do in {"sp", "mv", "operate"}:
        value = dict(_pair(text, written if do == "operate" else float) for text in options.values)
        do = "by_hand" if do == "mv" and options.take else do
    elif do == "course":
        value = (
            {"points": read_courses(options.courses, time.time(), settings.speed), "straight": options.straight}
            if options.courses
            else ({"end": options.end} if options.end else None)
        )
    elif options.back or options.keep:
        do, value = ("back", {"trial": options.trial}) if options.back else ("keep", None)
    else:
        value = {"file": str(options.controller.absolute()), "trial": options.trial}
    request = {"do": do, "value": value, "who": options.who, "reason": options.reason}
    if getattr(options, "accept_unproven", False):
        request["accept_unproven"] = True
    print(plain(str(ask(settings.journal.file, request)["done"])))
    if do == "swap":
        print(f"once it has the plant: {options.loop} still names the old file; a restart brings that one")
    elif do == "back":
        print(f"a restart brings the controller that {options.loop} names; see that it is the one put back")
    return 0


def _user() -> str:
    """The person who asks; a user without a name, as in a container, by number."""
    try:
        return getpass.getuser()
    except (OSError, KeyError):
        return f"uid {os.getuid()}"


def _pair(text: str, number: Callable[[str], float]) -> tuple[str, float]:
    name, _, value = text.partition("=")
    try:
        return name, number(value)
    except ValueError:
        switch = ", or true or false for a switch" if number is written else ""
        raise LoopError(f"{text!r} is no NAME=VALUE with a number{switch}") from None


def _init(options: argparse.Namespace) -> int:
    controller = Controller(options.file)
    if options.out.exists():
        raise LoopError(f"{options.out} is there already; name another file by --out, or remove it")
    from loopwright.serving.opcua.certificates import make

    folder = options.out.absolute().parent
    try:
        path = options.file.absolute().relative_to(folder)
    except ValueError:
        path = options.file.absolute()
    files = folder / "loop-certificate.der", folder / "loop-key.pem"
    before = [file.read_bytes() if file.is_file() else b"" for file in files]
    make(*files)
    kept = before == [file.read_bytes() for file in files]
    options.out.write_text(
        template(controller, path, options.endpoint, f"{options.out.stem}.journal"), encoding="utf-8"
    )
    pair = "loop-certificate.der (for the server to trust) and loop-key.pem"
    if kept:
        print(f"written: {options.out}; it uses {pair}, which were there already")
    else:
        print(f"written: {options.out}, and beside it {pair}")
    print(f"next: put the plant's node ids in, then `loopwright loop check {options.out}`")
    return 0


def _check(options: argparse.Namespace) -> int:
    settings = Settings.read(options.file)
    _quiet()
    controller = tried(settings.controller, settings.sha256 or None, settings.trusted)
    manifest = controller.manifest
    from loopwright.serving.opcua.inspection import Found, inspected
    from loopwright.serving.opcua.nameplates import KnownNode, others_since
    from loopwright.serving.station.build_loop import namespaces_before, nodes_before, rehearsed, require_free

    here = rehearsed(settings, controller)
    for line in here.wrong:
        print(plain(f"would stop the loop: {line}"), file=sys.stderr)
    said = len(here.wrong)
    before = namespaces_before(settings.journal.file, settings.server.endpoint)
    inspection = inspected(manifest, settings.server, settings.nodes, settings.guards.margin, before)
    rows = inspection.rows
    if not here.runs:
        here.tried(lambda: require_free(settings, inspection.identity))
    names = [f.name for f in fields(Found) if f.name not in {"wrong", "note", "passing", "written"}]
    table = [names, *([getattr(row, name) for name in names] for row in rows)]
    widths = [max(len(line[i]) for line in table) for i in range(len(names))]
    for cells in table:
        print(plain("  ".join(cell.ljust(width) for cell, width in zip(cells, widths, strict=True)).rstrip()))
    if controller.signed is not None:
        print(plain(f"{controller.path.name}: signed by {controller.signed.words}"))
    wrong = [*here.wrong[said:], *(f"{row.signal}: {row.wrong}" for row in rows if row.wrong)]
    notes = [f"{row.signal}: {row.note}" for row in rows if row.note]
    notes += others_since(
        nodes_before(settings.journal.file), {r.signal: KnownNode(r.node, r.kind, r.unit, r.limits) for r in rows}
    )
    for note in [*notes, *here.notes, *_unproven(manifest), *doubts(settings), *ending(controller)]:
        print(plain(f"note: {note}"))
    for line in wrong:
        print(plain(f"would stop the loop: {line}"), file=sys.stderr)
    if not wrong and not here.wrong:
        print("nothing would stop the loop")
    return 2 if wrong or here.wrong else 0


def _unproven(manifest: Manifest) -> list[str]:
    verdict = judged(manifest)
    return [f"{manifest.law} is {verdict.words}"] if verdict.why else []


def doubts(settings: Settings, *, running: bool = False) -> list[str]:
    """Lines on what is not secured; on the page of a ``running`` loop none that a plant for trials raises by itself."""
    server = settings.server
    return [
        *["neither sha256 nor trusted is set: any controller in that file would run"]
        * (not settings.sha256 and settings.trusted is None),
        *["security is None: what is sent can be read and changed on the way"] * (server.security == "None"),
        *["server_certificate is not set: any server at that address is believed"]
        * (server.security != "None" and server.server_certificate is None and not (running and _is_trial(settings))),
        *["no heartbeat: the plant cannot know whether this loop lives"] * (not settings.nodes.heartbeat),
        *["no watchdog: a server that shows old values is known by their source times alone"]
        * (not settings.nodes.watchdog),
    ]


def _is_trial(settings: Settings) -> bool:
    """Whether the plant is a simulated one, or at this machine's own address: nobody stands between it and the loop."""
    return settings.speed != 1 or urlsplit(settings.server.endpoint).hostname in OWN_ADDRESSES


def _run(options: argparse.Namespace) -> int:
    settings = Settings.read(options.file)
    _quiet()
    controller = tried(settings.controller, settings.sha256 or None, settings.trusted)
    misfits = _misfits(settings, controller.manifest)
    for line in misfits:
        print(plain(f"would stop the loop: {line}"), file=sys.stderr)
    if misfits:
        return 2
    from loopwright.serving.station.station import Station

    def tell(line: str) -> None:
        print(plain(line), flush=True)

    station = Station(settings, tell=tell, controller=controller)
    station.warnings = [*_unproven(station.manifest), *doubts(settings, running=True)]
    for line in station.warnings + station.ending():
        station.tell(f"note: {line}")
    station.watch(_Lines(station.manifest, station.tell).show)
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: station.end())
    report = station.run(options.scans)
    if station.snapshot is not None:
        station.tell(_left(station.manifest, station.snapshot.command))
    station.tell(f"{report.scans} scans, {report.missed} periods missed, {report.faults} scans with a fault")
    lost = station.journal.lost
    station.tell(f"journal: {settings.journal.file}" + (f"; {lost} scans and events are lost" if lost else ""))
    return JOURNAL_LOST if lost else 0


def _misfits(settings: Settings, manifest: Manifest) -> list[str]:
    """Faults of ``loop check`` that are for good: another unit, a node that is not there. None while nobody answers."""
    from loopwright.serving.opcua.inspection import inspected
    from loopwright.serving.station.build_loop import namespaces_before, require_free

    before = namespaces_before(settings.journal.file, settings.server.endpoint)
    with suppress(EndpointError):
        found = inspected(manifest, settings.server, settings.nodes, settings.guards.margin, before)
        require_free(settings, found.identity)
        return found.lasting(writes=settings.start != "SHADOW")
    return []


def _left(manifest: Manifest, last: Command) -> str:
    """The state in which the plant is left."""
    if not last.writes:
        return f"ended in {last.mode}: this loop does not write, and the plant keeps what others set"
    stay = ", ".join(f"{s.name} at {v:.5g} {s.unit}" for s, v in zip(manifest.mv, last.mv.tolist(), strict=True))
    return f"ended in {last.mode}: the plant keeps {stay}, and this loop moves it no more"


class _Lines:
    """A line for the first scan, for each change, and for one scan a minute."""

    def __init__(self, manifest: Manifest, tell: Callable[[str], None]) -> None:
        self.manifest, self.tell, self.every = manifest, tell, max(1, round(60 / manifest.period_s))
        self.last: tuple[str, tuple[float, ...], str] | None = None
        self.known = False  # whether the plant has shown itself: before, set points are none that anybody named

    def show(self, sample: Sample | None, command: Command) -> None:
        """Tell the scan if it is one of those."""
        now = (command.mode.value, tuple(command.sp.tolist()), command.fault)
        if now == self.last and command.scan % self.every:
            return
        self.last, m = now, self.manifest
        self.known = self.known or not command.fault
        parts = [f"SP {s.name} {v:.5g}" for s, v in zip(m.sp, command.sp.tolist(), strict=True) if self.known]
        if sample is not None:
            parts += [f"{s.name} {v:.5g} {s.unit}" for s, v in _known(m.pv, sample.pv)]
        parts += [f"{s.name} {v:.5g} {s.unit}" for s, v in _known(m.mv, command.mv)]
        if not command.writes and command.law_mv is not None:
            parts += [f"(law {s.name} {v:.5g})" for s, v in zip(m.mv, command.law_mv.tolist(), strict=True)]
        self.tell(f"{command.mode:<6}  {'  '.join(parts)}  {command.fault}".rstrip())


def _known(signals: Sequence[Signal], values: NDArray[np.float64]) -> list[tuple[Signal, float]]:
    """The signals whose value is known, which is no NaN."""
    return [(s, v) for s, v in zip(signals, values.tolist(), strict=True) if not isnan(v)]


def _export(options: argparse.Namespace) -> int:
    out = options.out or options.file.with_suffix(".csv")
    tags = out.with_name(f"{out.stem}-tags.csv")
    for file in (out, tags):
        if file.exists() and not options.replace:  # params.yaml may name it as the data of a controller
            raise LoopError(f"{file} is there already; name another file by --out, or write over it with --replace")
    rows = export(options.file, out)
    tag_table(options.file, tags)
    print(f"{rows} scans: {out}, its tags: {tags}")
    with closing(JournalReader(options.file)) as reader:
        period_s = reader.runs()[-1]["period_s"]
    # Without the period `new` would choose one, and a controller of another period could not be swapped in.
    print(f"next: `loopwright new NAME {out} --tags {tags} --period {period_s:g}` makes a record of it")
    return 0


def _events(options: argparse.Namespace) -> int:
    events = happened(journal_of(options.file), options.since, options.last)
    if options.csv:
        write_csv(events, sys.stdout)
    else:
        print("\n".join(lines(events) or ["nothing has happened there"]))
    return 0


def _report(options: argparse.Namespace) -> int:
    from loopwright.serving.monitor.weekly_report import week_reports

    reports = week_reports(journal_of(options.file), options.weeks)
    for i, report in enumerate(reports):
        print("\n".join([*[""] * bool(i), *map(plain, report.lines())]))
    return 0


def _quiet() -> None:
    """The loop itself reports a lost connection, in place of the library."""
    logging.getLogger("asyncua").setLevel(logging.CRITICAL)
