"""What validate measured of one law, and how to ask for one figure or one loop of it."""

from __future__ import annotations

import json
import statistics
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.errors import PipelineError
from pipeline.simulation import NOISE_SUFFIX

Array = NDArray[np.float64]
Loop = dict[str, Array]


class ReportError(PipelineError):
    """The stages left nothing that a report could be made of."""


def read_metrics(path: Path) -> dict[str, Any]:
    """The mapping in a metrics.json; ReportError where there is none."""
    try:
        tree = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise ReportError(f"{path} cannot be read ({error}); run `dvc repro`, which makes it again") from error
    if not isinstance(tree, dict):
        raise ReportError(f"{path} holds no mapping; run `dvc repro`, which makes it again")
    return tree


def parse_setting(name: str) -> dict[str, Any]:
    """What a variant's name says: ``"r=10, correction=back_calculation"`` as a mapping."""
    found: dict[str, Any] = {}
    for item in name.split(","):
        key, _, text = item.strip().partition("=")
        try:
            found[key] = float(text)
        except ValueError:
            found[key] = text or True
    return found


def lock_up_text(locked_up: Mapping[str, Mapping[str, int]]) -> str:
    """Tests with the data seeds that locked up in them: ``held_out (seeds 0, 3), step (seed 1)``."""
    return ", ".join(
        f"{test} (seed{'s' if len(seeds) > 1 else ''} {', '.join(seeds)})" for test, seeds in locked_up.items()
    )


@dataclass(frozen=True, slots=True)
class LawEvidence:
    """What validate measured of one law: metrics.json, the time of a step and, when asked for, trajectories.npz."""

    law: str
    metrics: Mapping[str, Any]
    trajectories: Path
    step_time: Mapping[str, float] = field(default_factory=dict)  # [us] p50, p99; empty: not timed

    @property
    def title(self) -> str:
        """The law in words."""
        return str(self.metrics.get("title") or self.law)

    @property
    def seeds(self) -> int:
        """Number of data seeds: each trained its own networks."""
        return len(self.metrics["seeds"])

    @property
    def lock_ups(self) -> int | None:
        """Closed loops that got stuck, over all seeds and scenarios."""
        found = self.metrics.get("lock_ups")
        return None if found is None else int(found)

    @property
    def locked_up(self) -> Mapping[str, Mapping[str, int]]:
        """Test -> data seed -> closed loops that got stuck; tests and seeds without one are left out."""
        return self.metrics.get("locked_up") or {}

    @property
    def as_printed(self) -> bool:
        """Whether the law is a reproduction of a paper's, shipped although it locked up."""
        return bool(self.metrics.get("as_printed"))

    def info(self, setting: Mapping[str, Any]) -> tuple[str, ...]:
        """Names of the controller's info with this setting, in the order of the trajectories' columns."""
        own = self.metrics.get("info") or ()
        return tuple((self.metrics.get("variant_info") or {}).get(self.variant_of(setting), own))

    @property
    def development(self) -> float | None:
        """Median of the data seeds' errors over the development sequences, in the case's metric.

        None with a lock-up there, or where nothing was measured.
        """
        found = self.metrics.get("development") or {}
        if not found or self.metrics.get("development_lock_ups"):
            return None
        return statistics.median(float(v) for v in found.values())

    @property
    def step_us(self) -> float | None:
        """Median time of a step [us]."""
        return self.step_time.get("p50")

    def variant_of(self, setting: Mapping[str, Any]) -> str | None:
        """Name of the variant with exactly this setting beside the shipped one; "" is the shipped law itself."""
        shipped = {k: float(v) if isinstance(v, int) else v for k, v in (self.metrics.get("setting") or {}).items()}
        wanted = {**shipped, **setting}
        for name in ("", *(self.metrics.get("variants") or {})):
            if wanted == {**shipped, **(parse_setting(name) if name else {})}:
                return name
        return None

    def block(self, scenario: str, setting: Mapping[str, Any]) -> Mapping[str, Any] | None:
        """Median, min, max and per_seed of one scenario; None where it was not run."""
        name = self.variant_of(setting)
        if name is None:
            return None
        tree = (self.metrics.get("variants") or {})[name] if name else self.metrics["scenarios"]
        if not name and scenario not in tree and scenario.endswith(NOISE_SUFFIX):
            tree, scenario = self.metrics.get("noise") or {}, scenario.removesuffix(NOISE_SUFFIX)
        found: Mapping[str, Any] | None = tree.get(scenario)
        return found

    @property
    def analyses(self) -> Mapping[str, Mapping[str, Any]]:
        """Every form's analysis (``figures`` and ``notes``) by its variant's name; "" is the shipped law's."""
        return {"" if form == "base" else form: said for form, said in (self.metrics.get("analysis") or {}).items()}

    def analysis(self, setting: Mapping[str, Any]) -> Mapping[str, Any]:
        """``figures`` and ``notes`` of the law's analysis with this setting; empty where it has none."""
        name = self.variant_of(setting)
        return {} if name is None else self.analyses.get(name, {})

    def analysis_arrays(self, setting: Mapping[str, Any]) -> Loop:
        """Arrays of the analysis by name; empty where none were kept."""
        path, name = self.trajectories.with_name("analysis.npz"), self.variant_of(setting)
        if name is None or not path.exists():
            return {}
        start = f"{name or 'base'}/"
        with np.load(path, allow_pickle=False) as file:
            return {k.removeprefix(start): np.asarray(file[k], float) for k in file.files if k.startswith(start)}

    def loop(self, scenario: str, setting: Mapping[str, Any]) -> Loop | None:
        """Trajectory of the shipped data seed, arrays (n, ...) by field; None where none was stored.

        Of a test of several sequences, or of several draws of the noise, it is the first.
        """
        name = self.variant_of(setting)
        if name is None or not self.trajectories.exists():
            return None
        with np.load(self.trajectories, allow_pickle=False) as file:
            start = f"{scenario}/{name or 'base'}/"
            keys = [k for k in file.files if k.startswith(start)]
            seeds = sorted({k[len(start) :].partition("/")[0] for k in keys})
            if not seeds:
                return None
            shipped = str(self.metrics.get("shipped_seed"))
            seed = shipped if shipped in seeds else seeds[0]
            return {k.rpartition("/")[2]: np.asarray(file[k], float) for k in keys if k.startswith(f"{start}{seed}/")}
