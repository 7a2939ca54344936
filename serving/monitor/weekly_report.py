"""A week of a loop in plain words: a headline, one table of its signals, and a short list of what stands out."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import TypeAlias

from loopwright.serving.errors import LoopError
from loopwright.serving.journal import JournalReader
from loopwright.serving.modes import Mode
from loopwright.serving.monitor.weekly import WEEK, Counts, counts_of, signals_in

Row: TypeAlias = tuple[str, ...]

COLUMNS = ("signal", "by the law", "out of use", "bad reading", "at low limit", "at high limit", "error or travel")
WORTH_SAYING = 0.01  # share of the time on control from which on a limit or a use is said: less is nobody's business
HOUR_S = 3600.0


@dataclass(frozen=True, slots=True)
class WeekReport:
    """The week that begins at ``week``, its ``headline``, a row of the table for each signal, and ``notes``."""

    week: str
    headline: str
    rows: tuple[Row, ...]
    notes: tuple[str, ...]

    def lines(self) -> list[str]:
        """All of it, as a terminal shows it."""
        table = [COLUMNS, *self.rows]
        widths = [max(len(row[k]) for row in table) for k in range(len(COLUMNS))]
        told = ["  ".join(cell.ljust(n) for cell, n in zip(row, widths, strict=True)).rstrip() for row in table]
        return [self.headline, *(told if self.rows else []), *(f"- {note}" for note in self.notes)]


def shares(counts: Mapping[str, float]) -> dict[str, float]:
    """Figures of a week by name: shares of the recorded time, and of the time on control where a signal is named."""
    recorded, auto = _recorded(counts), counts.get(Mode.AUTO, 0.0)
    if not recorded:
        return {}
    found = {f"{mode}_share": counts.get(mode, 0.0) / recorded for mode in Mode}
    if not auto:
        return found
    found["all_in_use_share"] = counts.get("all in use", 0.0) / auto
    hours = auto * counts.get("period_s", 0.0) / HOUR_S
    for _, name, of in signals_in(counts):
        for what, count in of.items():
            if what == "readings":
                found[f"{name}_mean_error"] = of.get("error", 0.0) / count
            elif what == "travel" and hours:
                found[f"{name}_travel_per_hour"] = count / hours
            elif what not in {"error", "travel", "readings", "validated", "low_limit", "high_limit"}:
                found[f"{name}_{what}_share"] = count / auto
    return found


def week_reports(journal: Path, last: int = 1) -> list[WeekReport]:
    """Reports of the ``last`` weeks that a journal has counts of, oldest first; also while it is written.

    LoopError where ``last`` is below 1, or the journal has no week.
    """
    if last < 1:
        raise LoopError(f"--weeks is {last}; it must be 1 or more")
    with closing(JournalReader(journal)) as reader:
        names = reader.learnt_names(WEEK)[-last:]
        kept = {name.removeprefix(WEEK): reader.learnt(name) or "{}" for name in names}
        units = {s["name"]: str(s["unit"]) for run in reader.runs() for g in ("pv", "mv") for s in run["signals"][g]}
    if not kept:
        raise LoopError(f"{journal} has no week yet: a loop counts from its first scan on, and writes once a minute")
    try:
        return [week_report(week, counts_of(text), units) for week, text in kept.items()]
    except ValueError as error:
        raise LoopError(f"{journal} has a week that cannot be read: {error}") from None


def week_report(week: str, counts: Mapping[str, float], units: Mapping[str, str]) -> WeekReport:
    """The report of a week; ``units`` are those of the signals by name, as far as they are known."""
    recorded, auto = _recorded(counts), counts.get(Mode.AUTO, 0.0)
    if not recorded:
        return WeekReport(week, f"week of {week}: no scan", (), ())
    hours = recorded * counts.get("period_s", 0.0) / HOUR_S
    modes = [f"{mode} {_percent(counts[mode] / recorded)}" for mode in Mode if counts.get(mode)]
    headline = f"week of {week}: {hours:.1f} h recorded; {', '.join(modes)}"
    if not auto:
        return WeekReport(week, headline, (), ("the law was not in control",))
    headline += f"; with every signal in use {_percent(counts.get('all in use', 0.0) / auto)} of the time in AUTO"
    known = list(signals_in(counts))
    auto_h = auto * counts.get("period_s", 0.0) / HOUR_S
    rows = tuple(_row(group, name, of, auto, auto_h, units.get(name, "")) for group, name, of in known)
    notes = [note for group, name, of in known for note in _notes(group, name, of, auto, units.get(name, ""))]
    held = counts.get(Mode.HOLD, 0.0) / recorded
    if held >= WORTH_SAYING:
        notes.insert(0, f"the loop held for {_percent(held)} of the recorded time")
    return WeekReport(week, headline, rows, tuple(notes))


def _row(group: str, name: str, of: Counts, auto: float, hours: float, unit: str) -> Row:
    def share(*whats: str) -> str:
        return _percent(sum(of.get(what, 0.0) for what in whats) / auto)

    if group == "cv":
        figure = f"{_figure(of.get('error', 0.0) / of['readings'], unit)} mean error" if of.get("readings") else "-"
        used, bad, ends = share("tracked", "ranged"), share("bridged", "shed"), (share("at_low"), share("at_high"))
    else:
        figure = f"{_figure(of.get('travel', 0.0) / hours, unit)} travel an hour" if hours else "-"
        used, bad = share("moved"), "-"
        ends = share("clamped_low", "end_low"), share("clamped_high", "end_high")
    return name, used, share("out"), bad, *ends, figure


def _notes(group: str, name: str, of: Counts, auto: float, unit: str) -> Iterator[str]:
    def said(what: str) -> str:
        share = of.get(what, 0.0) / auto
        return _percent(share) if share >= WORTH_SAYING else ""

    if group == "mv":
        for end in ("low", "high"):
            if share := said(f"clamped_{end}"):
                limit = _figure(of.get(f"{end}_limit", 0.0), unit)
                yield f"{name} stood at an operator's {end} limit for {share} of the time in AUTO, last at {limit}"
            if share := said(f"end_{end}"):
                yield f"{name} stood at the {end} end of its range for {share} of the time in AUTO"
        if share := said("fastest"):
            yield f"{name} moved as fast as it may for {share} of the time in AUTO"
        if share := said("out"):
            yield f"operators, or the plant, had {name} out of use for {share} of the time in AUTO"
        return
    if share := said("ranged"):
        yield f"{name} had a range and no set point for {share} of the time in AUTO"
    if share := said("out"):
        yield f"operators had {name} out of use for {share} of the time in AUTO"
    for what, words in (
        ("bridged", "was predicted, for its reading was bad,"),
        ("shed", "was left out for a bad reading"),
    ):
        if share := said(what):
            yield f"{name} {words} for {share} of the time in AUTO"
    for end in ("low", "high"):
        if share := said(f"at_{end}"):
            yield f"{name} was at the {end} end of its range or beyond for {share} of the time in AUTO"
    if of.get("readings") and "validated" in of:
        mean, worst = of.get("error", 0.0) / of["readings"], of["validated"]
        words = f"the mean error of {name} was {_figure(mean, unit)}; in the validation's noisy tests it was at most"
        yield f"{words} {_figure(worst, unit)}"


def _recorded(counts: Mapping[str, float]) -> float:
    return sum(counts.get(mode, 0.0) for mode in Mode)


def _percent(share: float) -> str:
    return f"{100 * share:.1f} %"


def _figure(value: float, unit: str) -> str:
    return f"{value:.3g} {unit if unit != '-' else ''}".strip()


def plain_rows(reports: Sequence[WeekReport]) -> list[dict[str, object]]:
    """Reports, JSON-ready."""
    return [
        {"week": r.week, "headline": r.headline, "columns": COLUMNS, "rows": r.rows, "notes": r.notes} for r in reports
    ]
