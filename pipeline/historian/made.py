"""A record that no historian delivered, such as a simulator's: judged and shown as one that was screened."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence

import numpy as np

from loopwright.pipeline.historian.cleaning.findings import Finding, Screening, TagReport
from loopwright.pipeline.historian.cleaning.grid import Grid
from loopwright.pipeline.historian.cleaning.record_rows import evenly
from loopwright.pipeline.historian.cleaning.sampling import Sampling
from loopwright.pipeline.historian.excitation import judged
from loopwright.pipeline.historian.files.export import Series
from loopwright.pipeline.historian.screening import Screened, models_of
from loopwright.pipeline.records.record import Record


def judged_record(
    plant: str, record: Record, files: Sequence[Mapping[str, str]], findings: Sequence[Finding], layout: str
) -> Screened:
    """Every row of one run kept, the report beside it, and the verdict; ``layout`` says where the rows come from."""
    h, n = record.period_s, len(record)
    groups = {"pv": record.pv_signals, "mv": record.mv_signals, "dv": record.dv_signals}
    columns = {s.name: getattr(record, r)[:, i] for r, group in groups.items() for i, s in enumerate(group)}
    good = np.zeros(n, np.uint8)
    excerpt = evenly(record)
    models = models_of(excerpt)
    grid = Grid(h, record.time_s, record.run, columns, dict.fromkeys(columns, good), dict.fromkeys(columns, 0))
    tags = tuple(
        TagReport(
            s.name, s.name, role, s.unit, s.low, s.high, {"good": n}, {}, {}, 0, 0.0,
            Sampling(s.name, h, irregular=False, dead_band=False, hold_s=h),
        )
        for role, group in groups.items() for s in group
    )  # fmt: skip
    report = Screening(
        plant=plant,
        files=tuple(dict(f) for f in files),
        layout=layout,
        file_rows=n,
        unreadable_rows=0,
        timeless_rows=0,
        period_s=h,
        gaps=0,
        gap_s=0.0,
        grid_rows=n,
        kept_rows=n,
        dropped_rows={},
        runs=1,
        longest_run_rows=n,
        tags=tags,
        modes={},
        findings=tuple(findings),
        verdict=judged(excerpt, models, 0, n),
    )
    series = {name: Series(name, record.time_s, values, good, Counter()) for name, values in columns.items()}
    return Screened(record, grid, good, series, report, models=models)
