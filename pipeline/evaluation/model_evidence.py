"""The figures of a model set: one figure by its path, and the rows of the report's tables."""

from __future__ import annotations

import statistics
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

Metrics = Mapping[str, Any]
IDENTIFIED = "identified"
"""The kind of part that has a section of its own in the report."""
HOW: dict[str, Callable[[Iterable[float]], float]] = {"median": statistics.median, "min": min, "max": max}


def model_figure(model: Metrics, path: str, how: str = "median") -> float | None:
    """One figure of a set over its data seeds, by its path in a part's own: ``one_step.nnarx``.

    The first part that has the path counts. A part that repeats a trial itself stores a list of
    values, or their ``median``, ``min`` and ``max``. None where nothing was measured.
    """
    for part in (model.get("parts") or {}).values():
        values = [v for row in (part.get("per_seed") or {}).values() for v in _values(_dig(row, path), how)]
        if values:
            return float(HOW[how](values))
    return None


def _dig(row: Any, path: str) -> Any:
    """The value at a dotted path; a key may itself hold dots (``recursive_0.8``)."""
    if not isinstance(row, Mapping):
        return None
    if path in row:
        return row[path]
    for key, value in row.items():
        if path.startswith(f"{key}.") and (inner := _dig(value, path[len(key) + 1 :])) is not None:
            return inner
    return None


def _values(leaf: Any, how: str) -> list[float]:
    if isinstance(leaf, Mapping):
        leaf = leaf.get(how)
    rows = leaf if isinstance(leaf, Sequence) and not isinstance(leaf, str) else [leaf]
    return [float(v) for v in rows if isinstance(v, int | float)]


def identified_part(models: Mapping[str, Metrics]) -> Metrics:
    """The figures of the identified model that laws are designed on, of its first data seed; empty without one."""
    for model in models.values():
        parts = [part for part in (model.get("parts") or {}).values() if part.get("kind") == IDENTIFIED]
        for part in parts:
            return next(iter((part.get("per_seed") or {}).values()), {})
    return {}


def model_rows(name: str, model: Metrics) -> list[dict[str, Any]]:
    """Rows of the models table, one for each part."""
    rows = []
    for part, figures in (model.get("parts") or {}).items():
        seeds = figures.get("per_seed") or {}
        median = figures.get("median") or {}
        rows.append(
            {
                "model": name,
                "part": part,
                "kind": figures.get("kind", ""),
                "horizon": figures.get("horizon"),
                "centres": median.get("centres"),
                "rmse": median.get("rmse"),
                "free_run": median.get("free_run_rmse"),
                "r2": median.get("r2"),
                "per_seed": {seed: s.get("rmse") for seed, s in seeds.items()},
                "regions": {r: v.get("rmse") for r, v in (median.get("regions") or {}).items()},
            }
        )
    return rows


def candidates(name: str, model: Metrics) -> list[dict[str, Any]]:
    """The search over lags and widths of each NNARX part: errors are medians over the data seeds.

    ``chosen`` of a row counts the seeds that took that candidate.
    """
    tables = []
    for part, figures in (model.get("parts") or {}).items():
        searches = [row["candidates"] for row in (figures.get("per_seed") or {}).values() if row.get("candidates")]
        sizes: dict[tuple[Any, ...], list[Metrics]] = {}
        for candidate in (c for search in searches for c in search):
            sizes.setdefault((candidate["n_y"], candidate["n_u"], *candidate["hidden"]), []).append(candidate)
        rows = [
            {
                "lags": f"{size[0]}, {size[1]}",
                "hidden": ", ".join(map(str, size[2:])),
                "parameters": tried[0]["parameters"],
                "rmse": statistics.median(c["rmse"] for c in tried),
                "free_run_rmse": statistics.median(c["free_run_rmse"] for c in tried),
                "chosen": sum(bool(c["chosen"]) for c in tried),
            }
            for size, tried in sizes.items()
        ]
        if rows:
            tables.append({"model": name, "part": part, "rows": rows, "seeds": len(searches)})
    return tables
