"""The table that `make run` ends with: every controller, its figures, and where to look."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from rich import box
from rich.console import Console
from rich.table import Table

from pipeline.errors import PipelineError

Validation = Mapping[str, Any]
WIDTH = 120


def show_results(artifacts: Path, console: Console | None = None) -> None:
    """Print a table for each artifacts/<case>/validation.json; raises PipelineError where there is none."""
    console = console or Console()
    if not console.is_terminal:
        # A log has no width of its own; the table is not worth cutting for one.
        console = Console(file=console.file, width=WIDTH)
    files = sorted(artifacts.glob("*/validation.json"))
    if not files:
        raise PipelineError(f"{artifacts} holds no validation.json yet; run the pipeline first: make run")
    for path in files:
        try:
            validation = json.loads(path.read_text(encoding="utf-8"))
            console.print(_table(validation, path.parent))
        except (OSError, ValueError, KeyError, AttributeError) as error:
            raise PipelineError(f"{path} cannot be read ({error!r}); run `dvc repro`") from error
        console.print(f"report     {path.parent / 'report.html'} (and .md, figures/, validation.json)")
        console.print(f"try one    python -m pipeline simulate {path.parent / '<law>.onnx'}")
        console.print(f"read one   python -m serving inspect {path.parent / '<law>.onnx'}")
    console.print("registry   make registry, then /#/models in the browser")


def _table(validation: Validation, folder: Path) -> Table:
    scenarios, bounds = validation["scenarios"], validation.get("bounds", {})
    metric = validation.get("metric", "mae")
    weights = (validation.get("gate") or {}).get("weights") or {}
    names = [name for name in scenarios if not name.endswith("_noise") or name in weights]
    main = max(weights, key=lambda name: weights[name], default=names[-1])
    words = (validation.get("titles") or {}).get("metric", "mean absolute error")
    title = f"{validation['case']}: {words}, median over data seeds; {main} / NMPC: the bound is 1"
    table = Table(title=title, title_justify="left", box=box.SIMPLE)
    table.add_column("law", no_wrap=True)
    for name in names:
        table.add_column(name, justify="right", no_wrap=True)
    table.add_column(f"{main} / NMPC", justify="right", no_wrap=True)
    table.add_column("size", justify="right", no_wrap=True)

    def ours(name: str, law: str) -> float | None:
        value = scenarios.get(name, {}).get(law, {}).get(metric)
        return None if value is None else float(value)

    def bound(name: str) -> float | None:
        value = bounds.get(name, {}).get("nmpc", {}).get(metric)
        return None if value is None else float(value)

    def key(law: str) -> float:
        value = ours(main, law)
        return math.inf if value is None else value

    for law in sorted({law for name in names for law in scenarios[name]}, key=key):
        file = folder / f"{law}.onnx"
        size = f"{file.stat().st_size / 1024:.0f} kB" if file.exists() else "-"
        table.add_row(law, *(_figure(ours(name, law)) for name in names), _ratio(ours(main, law), bound(main)), size)
    table.add_section()
    table.add_row("perfect NMPC", *(_figure(bound(name)) for name in names), "", "")
    return table


def _ratio(ours: float | None, bound: float | None) -> str:
    return f"{ours / bound:.2f}" if ours and bound else "-"


def _figure(value: float | None) -> str:
    """Four digits behind the point for a small figure, thousands grouped for a large one."""
    if value is None:
        return "-"
    if abs(value) >= 100:
        return f"{value:,.0f}"
    return f"{value:.4f}" if value >= 1e-3 else f"{value:.0e}"
