"""What happens to each kind of dirt in an export, and its cost: ``python benchmarks/damage.py [--write] [KIND ...]``.

One plant without dirt is exported; each kind spoils the export in its own way. `loopwright new` refuses it, masks it,
names it, or takes it. Of what it takes, a linear model is identified (regularized ARX, Hankel, output error) and run
free over rows of another, clean experiment. ``factor``: its error there over that of the model from the clean export.
Told: the only trace is what the data say of the plant (gain, first answer, settling), which a person is asked to
compare with it. Silent: nothing at all. About two minutes; ``--write`` puts the table into docs/damage.md.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from _exports import CLEAN, PERIOD_S, TAGS, Export, experiment
from _spoilt_exports import KINDS, Kind

from loopwright.pipeline.errors import ModelError, PipelineError
from loopwright.pipeline.historian.cleaning.tags import named
from loopwright.pipeline.historian.files.file_reader import read_export
from loopwright.pipeline.historian.screening import Screened, screen_export
from loopwright.pipeline.models.identified.linear_start import Realizations, high_order_arx
from loopwright.pipeline.models.identified.output_error import Fitted, OutputErrorFit, fit_starts, residuals
from loopwright.pipeline.models.identified.scaled_record import ScaledRecord, Scales
from loopwright.pipeline.plants.simulator import Array, Signals
from loopwright.pipeline.records.record import Record

PAGE = Path("docs") / "damage.md"
ORDERS = (2, 3, 4)
SILENT_FACTOR = 1.2  # that nothing accepted in silence may exceed
HEAD = """# What dirt in an export costs

Written by `python benchmarks/damage.py --write`. A plant with one manipulated variable and one measured disturbance
(second order, dead time of two samples, {rows} rows) is exported without dirt, and each kind spoils the export.
**Factor**: error of a linear model's free run over clean rows of another experiment (its standard deviation: feedback
removes a constant offset), over that of the model from the clean export. **Told**: `new` prints when each variable
first answers, and asks whether it is so on the plant; here that figure differs from the clean export's ({usual}).
A dash: no record was made, or no model came out of it.

| Kind | What happens | Factor |
|---|---|---:|
"""


@dataclass(frozen=True)
class Outcome:
    """What became of one export."""

    kind: str
    what: str  # refused, not added, doubted, masked, named, told, accepted in silence
    words: str
    factor: float | None


def main(arguments: Sequence[str] | None = None) -> int:
    """Print the table; 1 where something accepted in silence costs more than SILENT_FACTOR."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("kinds", metavar="KIND", nargs="*", help="words in the names of kinds (all)")
    parser.add_argument("--write", action="store_true", help=f"write {PAGE}")
    options = parser.parse_args(arguments)
    chosen = [k for k in KINDS if not options.kinds or any(word in k.name for word in options.kinds)]
    with tempfile.TemporaryDirectory() as folder:
        clean = taken(CLEAN, Path(folder))
        yardstick, usual = error_of(clean.record), answers_of(clean)
        rows = []
        for kind in chosen:
            rows.append(outcome(kind, Path(folder), yardstick, usual))
            print(line(rows[-1]), flush=True)
    if options.write:
        page = HEAD.format(
            rows=len(experiment(0).pv), usual=", ".join(f"{pv} {s:g} s after {u}" for (u, pv), s in usual.items())
        ) + "".join(line(row) + "\n" for row in rows)
        PAGE.write_text(page, encoding="utf-8")
    costly = [r.kind for r in rows if r.what == "accepted in silence" and (r.factor or 9.9) > SILENT_FACTOR]
    for name in costly:
        print(f"{name}: accepted in silence, and costs more than {SILENT_FACTOR:g}", file=sys.stderr)
    return 1 if costly else 0


def line(row: Outcome) -> str:
    """The row of the table."""
    factor = "–" if row.factor is None else f"{row.factor:.2f}" if row.factor < 100 else f"{row.factor:.2g}"
    return f"| {row.kind} | **{row.what}**{': ' if row.words else ''}{row.words.replace('|', '/')} | {factor} |"


def taken(export: Export, folder: Path) -> Screened:
    """The export after `loopwright new`; PipelineError where it refuses."""
    paths = export.write(folder)
    tags = named(export.tags or TAGS)
    values, modes = ([t.tag for t in tags if (t.role == "mode") is m] for m in (False, True))
    return screen_export("plant", read_export(paths, values, modes), tags, **export.options)


def outcome(kind: Kind, folder: Path, yardstick: float, usual: Mapping[tuple[str, str], float]) -> Outcome:
    """What becomes of one kind."""
    export = kind.spoil()
    try:
        found = taken(export, folder)
    except PipelineError as error:
        return Outcome(kind.name, "refused", str(error).replace(f"{folder}/", ""), None)
    report = found.report
    masked = {k: n for k, n in report.dropped_rows.items() if k != "short_run"}
    readings: dict[str, int] = {}
    for tag in report.tags:
        for reason, n in tag.readings.items():
            if reason != "good":
                readings[reason] = readings.get(reason, 0) + n
    words = [f"{f.tag}: {f.words}" for f in report.findings]
    if masked:
        words.append("rows left out: " + ", ".join(f"{n} {k.replace('_', ' ')}" for k, n in masked.items()))
    if report.gaps:
        words.append(f"{report.gaps} gap{'s' if report.gaps > 1 else ''}")
    if report.unreadable_rows or report.timeless_rows:
        words.append(f"{report.unreadable_rows} unreadable lines, {report.timeless_rows} without time")
    verdict = report.verdict
    if verdict.carries != "yes":
        words.append("; ".join(verdict.reasons))
    told = {pair: s for pair, s in answers_of(found).items() if s != usual.get(pair)}
    words += [f"{pv} is said to answer {s:g} s after {u}" for (u, pv), s in told.items()] if not words else []
    what = (
        "not added" if verdict.carries == "no"
        else "doubted" if verdict.carries == "doubtful"
        else "masked" if masked or readings or report.unreadable_rows or report.timeless_rows or report.gaps
        else "told" if told and not report.findings
        else "named" if words
        else "accepted in silence"
    )  # fmt: skip
    try:
        factor = error_of(found.record, export.lower) / yardstick
    except (ModelError, PipelineError, np.linalg.LinAlgError):
        factor = None
    return Outcome(kind.name, what, "; ".join(words), factor)


def answers_of(found: Screened) -> dict[tuple[str, str], float]:
    """(input, PV) -> seconds from a move to the first answer, as `loopwright new` tells them."""
    return {(i.name, pv): s for i in found.report.verdict.inputs for pv, s in i.first_answer_s.items()}


def error_of(record: Record, lower: float = 0.0) -> float:
    """Free-run error of the record's best linear model over clean rows of another experiment, in the PV's unit."""
    scales = Scales.of(record, 1)
    data = ScaledRecord.of(record, scales)
    stretches = data.stretches()
    cut = max(1, int(0.8 * len(stretches))) if len(stretches) > 1 else 1
    train, held = stretches[:cut], stretches[cut:]
    if len(stretches) == 1:
        n = int(0.8 * len(data))
        train, held = data.rows(slice(0, n)).stretches(), data.rows(slice(n, None)).stretches()
    realizations = Realizations.of(high_order_arx(data).impulse_response(100), data.v.std(axis=0))
    fits: list[Fitted] = [OutputErrorFit(iterations=25).fit(realizations.order(n), train, held) for n in ORDERS]
    best = min(fits, key=lambda f: f.held_out)
    clean = experiment(1)
    signals = Signals(record.period_s, record.pv_signals, record.pv_signals, record.dv_signals, record.mv_signals)
    n = max(1, round(record.period_s / PERIOD_S))
    # Rows of several readings: the MV from their time on, PV and disturbance up to it, as `loopwright new` takes them.
    mv = means(clean.mv[n - 1 :], n)
    pv, dv = (means(values, n)[: len(mv)] for values in (clean.pv, clean.dv))
    test = Record.of(signals, pv[:, None] - lower, mv[:, None], dv=dv[:, None])
    rows = ScaledRecord.of(test, scales).stretches()
    rest = residuals(best.model, fit_starts(best.model, rows), rows)
    if rest is None:
        raise ModelError("the model explodes on the clean rows")
    return float(rest[0].std() * scales.y_scale[0])


def means(values: Array, n: int) -> Array:
    """The means (m // n,) of each ``n`` of the values (m,)."""
    return np.asarray(values[: len(values) // n * n].reshape(-1, n).mean(axis=1))


if __name__ == "__main__":
    sys.exit(main())
