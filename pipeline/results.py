"""The table that `make run` ends with: every controller, its figures, and where to look."""

from __future__ import annotations

import json
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
    names = [name for name in scenarios if not name.endswith("_noise")]
    title = f"{validation['case']}: mean absolute error, median over data seeds; held_out / NMPC: the bound is 1"
    table = Table(title=title, title_justify="left", box=box.SIMPLE)
    table.add_column("law", no_wrap=True)
    for name in names:
        table.add_column(name, justify="right", no_wrap=True)
    table.add_column("held_out / NMPC", justify="right", no_wrap=True)
    table.add_column("size", justify="right", no_wrap=True)
    laws = sorted({law for name in names for law in scenarios[name]}, key=lambda law: _sort_key(scenarios, names, law))
    for law in laws:
        figures = [scenarios[name].get(law, {}).get("mae") for name in names]
        file = folder / f"{law}.onnx"
        size = f"{file.stat().st_size / 1024:.0f} kB" if file.exists() else "-"
        table.add_row(law, *map(_figure, figures), _ratio(scenarios, bounds, law), size)
    nmpc = [bounds.get(name, {}).get("nmpc", {}).get("mae") for name in names]
    table.add_section()
    table.add_row("perfect NMPC", *map(_figure, nmpc), "", "")
    return table


def _sort_key(scenarios: Validation, names: list[str], law: str) -> float:
    last = names[-1] if "held_out" not in names else "held_out"
    value = scenarios[last].get(law, {}).get("mae")
    return float("inf") if value is None else float(value)


def _ratio(scenarios: Validation, bounds: Validation, law: str) -> str:
    ours = scenarios.get("held_out", {}).get(law, {}).get("mae")
    bound = bounds.get("held_out", {}).get("nmpc", {}).get("mae")
    return f"{ours / bound:.2f}" if ours and bound else "-"


def _figure(value: float | None) -> str:
    return "-" if value is None else f"{value:.4f}" if value >= 1e-3 else f"{value:.0e}"
