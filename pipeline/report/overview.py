"""The overview of all cases: every law, its best figure beside its bound, and what the papers claim."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

from loopwright.pipeline.evaluation.leaderboard import CaseStanding, LawStanding, tally
from loopwright.pipeline.pictures.numbers import ratio
from loopwright.pipeline.report.templating import REGISTRY_URL, render, write_pages

Count = tuple[int, int]


def write_overview(standings: Sequence[CaseStanding], out: Path) -> list[Path]:
    """Write report.html and report.md into ``out``, the folder of the cases' folders; returns their paths."""
    content = context(standings, out)
    return write_pages(out, {name: render(f"overview.{name.partition('.')[2]}.j2", content) for name in PAGES})


PAGES = ("report.html", "report.md")


def context(standings: Sequence[CaseStanding], out: Path) -> dict[str, Any]:
    """Everything that the templates show."""
    return {
        "cases": [_case(standing, out) for standing in standings],
        "laws": len({law.law for standing in standings for law in standing.laws}),
        "controllers": sum(len(standing.laws) for standing in standings),
        "requirements": _sum(tally(standing.requirements) for standing in standings),
        "claims": _sum(tally(standing.claims) for standing in standings),
        "figures": _sum(standing.reproduced for standing in standings),
        "missed": [(s, row) for s in standings for row in s.requirements if row.holds is False],
        "registry": REGISTRY_URL,
    }


def _sum(counts: Iterable[Count]) -> Count:
    rows = list(counts)
    return sum(good for good, _ in rows), sum(known for _, known in rows)


def _case(standing: CaseStanding, out: Path) -> dict[str, Any]:
    picture = standing.folder / "figures" / "closed_loop.png"
    return {
        "of": standing,
        "link": standing.folder.relative_to(out).as_posix(),
        "laws": [_law(standing, law, out) for law in standing.laws],
        "picture": picture.relative_to(out).as_posix() if picture.exists() else None,
        "requirements": tally(standing.requirements),
        "claims": tally(standing.claims),
        "verdict": _verdict(standing),
    }


def _law(standing: CaseStanding, law: LawStanding, out: Path) -> dict[str, Any]:
    picture = standing.folder / "figures" / f"closed_loop_{law.law}.png"
    return {
        "of": law,
        "registry": f"{REGISTRY_URL}/{standing.case}-{law.law}",
        "picture": picture.relative_to(out).as_posix() if picture.exists() else None,
        "spread": law.seeds is not None and law.seeds > 1 and law.low is not None and law.high is not None,
    }


def _verdict(standing: CaseStanding) -> str:
    """The case in a sentence or two: its best law beside the bound, and what tests on models rest on."""
    tested = "" if standing.grounds is None else f" Tested {standing.grounds.words}."
    return _best(standing) + tested


def _best(standing: CaseStanding) -> str:
    best = standing.best
    if best is None:
        return "No law qualifies as best controller."
    if best.ratio is None:
        return f"Best controller: {best.title}."
    if standing.times != "× NMPC":
        return f"Best controller: {best.title}, {ratio(best.ratio)} {standing.times} ({standing.metric})."
    if standing.hidden:
        return f"Best controller: {best.title}, {ratio(best.ratio)} × the {standing.metric} that noise can hide."
    return f"Best controller: {best.title}, {ratio(best.ratio)} × the perfect-model NMPC's {standing.metric}."
