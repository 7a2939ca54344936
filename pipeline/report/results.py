"""The table that `make run` ends with: every case and every controller, and where to look."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from itertools import zip_longest
from pathlib import Path

from rich import box
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from loopwright.pipeline.config.params import PARAMS_FILE, entries, sections
from loopwright.pipeline.errors import PipelineError
from loopwright.pipeline.evaluation.leaderboard import CaseStanding, LawStanding, by_reason, tally, withheld_in
from loopwright.pipeline.evaluation.metric import with_unit
from loopwright.pipeline.evaluation.operated import summary_of
from loopwright.pipeline.evaluation.validation import FILE, Validation
from loopwright.pipeline.pictures.numbers import ratio
from loopwright.pipeline.simulation import NOISE_SUFFIX
from loopwright.serving.controller_file import controller_files

RESULTS_WIDTH = 120  # letters of the table, where no terminal says how wide it is
REMARK_RATIO = 0.99  # ratio to the bound below which a remark says why
LONGEST_HEADS = 40  # letters of the names of laws side by side that a line of 80 has room for, beside the tests


def show_results(artifacts: Path, console: Console | None = None, case: str | None = None) -> None:
    """Print one table over all artifacts/<case>/validation.json, or the table of one case with all its tests.

    Raises PipelineError where there is none.
    """
    console = console or Console()
    if not console.is_terminal:
        # A log has no width; a fixed one keeps the table whole.
        console = Console(file=console.file, width=RESULTS_WIDTH)
    folders = sorted(path.parent for path in artifacts.glob("*/validation.json"))
    if not folders:
        raise PipelineError(
            f"{artifacts.absolute()} holds no results; run the pipeline first (loopwright run), or go to the folder in "
            "which it ran"
        )
    standings = {folder.name: CaseStanding.read(folder) for folder in folders}
    if case is not None and case not in standings:
        raise PipelineError(f"{artifacts} holds no case {case!r}; it has {', '.join(standings)}")
    if case is not None:  # no title of the table, which would be broken to its width
        own = standings[case]
        words = f"{case}: {with_unit(own.metric_long, own.unit)}, median over data seeds"
        console.print(words, style="italic", markup=False, soft_wrap=True)
    if case is None or standings[case].laws:  # a table of bounds alone says nothing
        console.print(overview(standings.values()) if case is None else _tests(standings[case]))
    for name, standing in standings.items():
        if standing.grounds is not None and standing.grounds.warning and case in (None, name):
            console.print(f"{name}: {standing.grounds.warning}", style="bold red", markup=False, soft_wrap=True)
    where, shipped = artifacts / (case or "<case>"), list[LawStanding]()
    for name, standing in standings.items():
        if case not in (None, name):
            continue
        withheld = withheld_in(standing.folder)
        given = _given(artifacts.parent / PARAMS_FILE, name)
        # A file that a controller left which has been taken out since says nothing.
        current = {law: why for law, why in withheld.items() if given is None or law in given}
        current.pop(standing.old_loop, None)  # it is shown, and was never to be shipped
        for laws, why in by_reason(current).items():
            line = f"{name}: {laws} {'are' if ', ' in laws else 'is'} not shipped, {why}"
            console.print(line, style="red", markup=False, soft_wrap=True)
        shipped += [law for law in standing.laws if law.law not in withheld]
        if without_controller(artifacts, name):
            page = standing.folder / "report.html"
            line = f"{name}: no controller is shipped, for the reasons above; {page} shows the model"
            console.print(line, style="bold red", markup=False, soft_wrap=True)
    if any(law.lock_ups for law in shipped):
        console.print(
            "!          number of closed loops that locked up; the law reproduces a paper: do not run it on a plant"
        )
    best = None
    if any(standing.hidden for name, standing in standings.items() if case in (None, name)):
        console.print("n          noise can hide more than the bound: the ratio is to the hidden error, at least 1")
    if case is None:
        if any(_ahead(law) for of in standings.values() if of.times == "× NMPC" for law in of.laws):
            console.print(
                "below 1    ahead of the NMPC, which knows the plant but no load before it shows, and plans so far"
            )
        if any(standing.times != "× NMPC" for standing in standings.values()):
            console.print(
                "×          where there is no bound, as on a simulator of your own, the ratio is to what it names"
            )
        console.print("*          the best law of its case, chosen on development sequences that are not scored")
        console.print(f"overview   {artifacts / 'report.html'} (and .md)")
        console.print(f"a case     {where / 'report.html'}; its tests here: loopwright results CASE")
    else:
        best = next((law.law for law in standings[case].laws if law.best), None)
        if best is not None:
            console.print(f"the best   {where / f'{best}.onnx'}")
            if line := _beside_the_old_loop(standings[case]):
                console.print(f"           {line}", markup=False, soft_wrap=True)
            for line in _beside_the_best(standings[case], shipped):
                console.print(f"           {line}", style="red", markup=False, soft_wrap=True)
        elif any(law.law == standings[case].old_loop for law in standings[case].laws) and shipped:
            console.print("           no controller beats the old loop in all tests", style="bold red")
        console.print(f"report     {where / 'report.html'} (and .md, figures/, validation.json)")
    # In quotes where a word has to be put in: a shell takes the brackets for something else.
    one = f"{where / best}.onnx" if best is not None else f"'{where / '<law>.onnx'}'"
    if any(controller_files(standing.folder) for name, standing in standings.items() if case in (None, name)):
        console.print(f"try one    loopwright simulate {one}")
        console.print(f"read one   loopwright inspect {one}")
    console.print("registry   make registry, then /#/models in the browser")


def _beside_the_old_loop(standing: CaseStanding) -> str:
    """By how much the best law is better or worse than the loop that the plant was run by before, test by test."""
    found = [(test, 100 * share) for test, share in standing.over_old_loop.items()]
    parts = [
        f"{word} {standing.metric} than the old loop: {', '.join(f'{t} {abs(s):.0f} %' for t, s in rows)}"
        for word, rows in (("lower", [r for r in found if r[1] >= 0]), ("higher", [r for r in found if r[1] < 0]))
        if rows
    ]
    return "; ".join(parts)


def _beside_the_best(standing: CaseStanding, shipped: Iterable[LawStanding]) -> list[str]:
    """Warnings for a person who takes the best controller: requirements missed, loops that swing."""
    lines = [f"not met: {row.what}" for row in standing.requirements if row.holds is False]
    return [*lines, *(f"{law.law} swings to the end in {law.swings}" for law in shipped if law.swings)]


def without_controller(artifacts: Path, case: str) -> bool:
    """Whether a case has a report and withholds every law, so that its folder in ``artifacts`` has no controller."""
    folder = artifacts / case
    return (folder / FILE).is_file() and bool(withheld_in(folder)) and not controller_files(folder)


def _given(params: Path, case: str) -> tuple[str, ...] | None:
    """The controllers that the case has; None where artifacts lie by themselves, and nobody can say."""
    if not params.is_file() or case not in sections("cases", params):
        return None
    return entries("controllers", case, "name", params)


def overview(standings: Iterable[CaseStanding]) -> Table:
    """One row a law: figure on the test that weighs most, bound, ratio, time of a step, size of the file."""
    table = Table(box=box.SIMPLE, title_justify="left", pad_edge=False)
    table.title = "Each case's main test, median over data seeds; the bound is the perfect-model NMPC"
    for name, right in (
        ("case", False), ("law (* the best)", False), ("figure", True), ("bound", True), ("ratio", True),
        ("step", True), ("size", True),
    ):  # fmt: skip
        table.add_column(name, justify="right" if right else "left", no_wrap=True)
    for standing in standings:
        for about, law in zip_longest(_about(standing), standing.laws, fillvalue=None):
            table.add_row(about or "", *(_row(standing, law) if law is not None else ()))
        table.add_section()
    return table


def _about(standing: CaseStanding) -> list[str]:
    """The first column of a case, a line a row."""
    lines = [f"[bold]{standing.case}[/bold]", f"{escape(with_unit(standing.metric, standing.unit))}, {standing.test}"]
    if standing.grounds is not None:
        fits = [fit for fit in standing.grounds.fit.values() if fit is not None]
        lines += ["on models of your data", f"their fit {min(fits):.3g} %" if fits else "which do not run free"]
    for words, (good, known) in (
        ("requirements", tally(standing.requirements)),
        ("claims reproduce", tally(standing.claims)),
        ("figures reproduce", standing.reproduced),
    ):
        if known:
            lines.append(f"{good} of {known} {words}")
    return lines


def _row(standing: CaseStanding, law: LawStanding) -> tuple[str, ...]:
    return (
        (f"[bold]{law.law} *[/bold]" if law.best else law.law)
        + (f" [red]!{law.lock_ups}[/red]" if law.lock_ups else ""),
        _figure(law.figure),
        _figure(standing.bound),
        _multiple(standing, law),
        "-" if law.step_us is None else f"{law.step_us:.0f} us",
        _size(law),
    )


def _tests(standing: CaseStanding) -> Table:
    """The laws of a case in all its tests, a row a test."""
    validation = Validation.read(standing.folder / FILE)
    scenarios, metric, weights = validation.scenarios, validation.metric, validation.gate.weights
    names = [name for name in scenarios if not name.endswith(NOISE_SUFFIX) or name in weights]
    table = Table(box=box.SIMPLE)
    table.add_column("test", no_wrap=True)
    heads = ("NMPC", *(law.law for law in standing.laws))
    # Many names side by side fit a line only if each breaks at its underscores.
    broken = sum(map(len, heads)) > LONGEST_HEADS
    for name in heads:
        table.add_column(name.replace("_", "_\n") if broken else name, justify="right", no_wrap=True)

    def ours(name: str, law: str) -> float | None:
        return scenarios[name].get(law, {}).get(metric)

    for name in names:
        table.add_row(name, _figure(validation.bound(name)), *(_figure(ours(name, law.law)) for law in standing.laws))
        for own, words in validation.of_each_cv.items():
            known = [scenarios[name].get(law.law, {}).get(own) for law in standing.laws]
            bound = validation.bounds.get(name, {}).get("nmpc", {}).get(own)
            table.add_row(f"  {escape(words)}", *map(_figure, (bound, *known)), style="dim")
    table.add_section()
    table.add_row(f"{standing.test} / {standing.times[2:]}", "", *(_multiple(standing, law) for law in standing.laws))
    if standing.travel:
        travels = (standing.travel_bound, *(law.travel for law in standing.laws))
        table.add_row(escape(f"{standing.travel}, {standing.travel_test}"), *map(_figure, travels))
    for words, row in _operated(validation, [law.law for law in standing.laws]):
        table.add_row(words, "", *row)
    table.add_row("lock-ups", "", *(("-" if law.lock_ups is None else str(law.lock_ups)) for law in standing.laws))
    table.add_row("size", "", *map(_size, standing.laws))
    return table


def _operated(validation: Validation, laws: Iterable[str]) -> Iterator[tuple[str, list[str]]]:
    """Rows on tests in which operators change more than set points: the worst of each law; none without such a law."""
    found = [summary_of(validation.laws[law].operated) for law in laws]
    for name, words in (("outside_late", "outside a range, % of time"), ("gain", "profit, % of what is to be gained")):
        if any(name in of for of in found):
            yield words, ["-" if name not in of else f"{100 * of[name]:.3g}" for of in found]


def _size(law: LawStanding) -> str:
    return "-" if law.bytes is None else f"{law.bytes / 1024:.0f} kB"


def _ahead(law: LawStanding) -> bool:
    """Whether a law's figure is below the bound by more than its digits show as 1."""
    return law.ratio is not None and law.ratio < REMARK_RATIO


def _multiple(standing: CaseStanding, law: LawStanding) -> str:
    """Two decimals, more within 1 % of the bound; what it is a multiple of, where there is no bound.

    ``n`` marks a bound below the error that noise can hide.
    """
    if law.ratio is None:
        return "-"
    if standing.times != "× NMPC":
        return f"{ratio(law.ratio)} {standing.times}"
    return f"{law.ratio:.2f}n" if standing.hidden else ratio(law.ratio)


def _figure(value: float | None) -> str:
    """Four digits behind the point, three digits of a smaller figure, thousands grouped in a large one."""
    if value is None:
        return "-"
    if abs(value) >= 100:
        return f"{value:,.0f}"
    return f"{value:.4f}" if abs(value) >= 0.01 else f"{value:.3g}"
