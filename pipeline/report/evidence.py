"""All closed-loop figures of a case in one place, and how to ask for one."""

from __future__ import annotations

import hashlib
import json
import statistics
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from pipeline.cases import NOISE_SUFFIX, Case
from pipeline.cases.base import Curve
from pipeline.errors import PipelineError

Array = NDArray[np.float64]
Loop = dict[str, Array]
Bounds = Mapping[str, Mapping[str, Mapping[str, float]]]

METRICS = ("mae", "ise", "masse", "max_asse", "overshoot", "settling", "mv_travel")
ORDER = ("inc", "incad", "incadec", "pid", "inverse_dob", "forward_dob")


class ReportError(PipelineError):
    """The stages left nothing that a report could be made of."""


def _read(path: Path) -> dict[str, Any]:
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


@dataclass(frozen=True, slots=True)
class LawEvidence:
    """What validate measured of one law: metrics.json and, loaded when asked for, trajectories.npz."""

    law: str
    metrics: Mapping[str, Any]
    trajectories: Path

    @property
    def title(self) -> str:
        """The law in words."""
        return str(self.metrics.get("title") or self.law)

    @property
    def seeds(self) -> int:
        """Number of data seeds."""
        return len(self.metrics["seeds"])

    @property
    def lock_ups(self) -> int | None:
        """Closed loops that got stuck, over all seeds and scenarios."""
        found = self.metrics.get("lock_ups")
        return None if found is None else int(found)

    @property
    def development(self) -> float | None:
        """Median MAE of the data seeds over the development sequences; None with a lock-up there, or unmeasured."""
        found = self.metrics.get("development") or {}
        if not found or self.metrics.get("development_lock_ups"):
            return None
        return statistics.median(float(v) for v in found.values())

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

    def loop(self, scenario: str, setting: Mapping[str, Any]) -> Loop | None:
        """Trajectory of the shipped data seed, arrays (n, ...) by field; None where none was stored."""
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


@dataclass(frozen=True)
class Evidence:
    """The case, its bounds, and what the stages measured of its laws and models."""

    case: Case
    bounds: Bounds
    laws: Mapping[str, LawEvidence]
    models: Mapping[str, Mapping[str, Any]]

    @classmethod
    def load(
        cls,
        case: Case,
        bounds: Bounds,
        work: Path,
        laws: Collection[str] | None = None,
        models_of: Collection[str] | None = None,
    ) -> Self:
        """What lies under ``work`` = work/<case>, of the named laws and model sets (None: all that lie there).

        A law or set that params.yaml no longer lists leaves its folder behind; it is no evidence any more.
        Raises ReportError where no law was validated.
        """
        validation, models = work / "validation", work / "models"
        names = sorted(p.parent.name for p in validation.glob("*/metrics.json"))
        names = [n for n in names if laws is None or n in laws]
        names.sort(key=lambda n: ORDER.index(n) if n in ORDER else len(ORDER))
        if not names:
            raise ReportError(f"{validation} holds no law's metrics.json; run `dvc repro`")
        return cls(
            case,
            bounds,
            {
                n: LawEvidence(n, _read(validation / n / "metrics.json"), validation / n / "trajectories.npz")
                for n in names
            },
            {
                p.parent.name: _read(p)
                for p in sorted(models.glob("*/metrics.json"))
                if models_of is None or p.parent.name in models_of
            },
        )

    @cached_property
    def scenarios(self) -> dict[str, str]:
        """Title of each scenario, without those with noise."""
        titles = {}
        for name, tests in self.case.scenarios().items():
            titles[name] = (
                tests[0].title if len(tests) == 1 else f"{len(tests)} held-out sequences of random set points"
            )
        return titles

    def figure(
        self,
        law: str,
        scenario: str,
        metric: str = "mae",
        setting: Mapping[str, Any] | None = None,
        how: str = "median",
    ) -> float | None:
        """One figure over the data seeds (median, min or max); None where it was not measured."""
        if law not in self.laws:
            return None
        block = self.laws[law].block(scenario, setting or {})
        value = ((block or {}).get(how) or {}).get(metric)
        return None if value is None else float(value)

    def bound(self, scenario: str, metric: str = "mae", kind: str = "nmpc") -> float | None:
        """A bound's figure; None where none was computed."""
        value = self.bounds.get(scenario, {}).get(kind, {}).get(metric)
        return None if value is None else float(value)

    @cached_property
    def floor(self) -> float:
        """Error below which a loop is as good as perfect: the measurement noise of the controlled variable.

        An NMPC that is told of a disturbance before it acts leaves an error of 1e-11: no yardstick.
        """
        return float(self.case.noise[self.case.plant_class.sp_signals[0].name])

    def ratio(self, law: str, scenario: str, kind: str = "nmpc") -> float | None:
        """MAE of the law over that of the bound; None also where the bound lies below ``floor``."""
        own, bound = self.figure(law, scenario), self.bound(scenario, "mae", kind)
        return None if own is None or bound is None or bound < self.floor else own / bound

    def gate_ratio(self, law: str, scenario: str) -> float | None:
        """MAE over the NMPC's, both at least ``floor``: 1 is the bound, or an error that noise would hide."""
        own, bound = self.figure(law, scenario), self.bound(scenario)
        return None if own is None or bound is None else max(own, self.floor) / max(bound, self.floor)

    def score(self, law: str) -> float | None:
        """Gate score: weighted mean of ``gate_ratio`` over the gate's scenarios; lower is better, 1 the bound."""
        ratios = {s: self.gate_ratio(law, s) for s in self.case.gate}
        known = {s: r for s, r in ratios.items() if r is not None}
        if not known or len(known) < len(ratios):
            return None
        return sum(self.case.gate[s] * r for s, r in known.items()) / sum(self.case.gate.values())

    @cached_property
    def best(self) -> str | None:
        """The law with the lowest error over the development sequences, no scored test asked.

        A law that locked up on one of them is out. Where no development was measured: by the gate score.
        """
        errors = {n: law.development for n, law in self.laws.items()}
        if all(error is None for error in errors.values()):
            errors = {n: self.score(n) for n, law in self.laws.items() if law.lock_ups == 0}
        known = {n: e for n, e in errors.items() if e is not None}
        return min(known, key=lambda n: known[n], default=None)

    def loop(self, curve: Curve, scenario: str, hold: int | None = None) -> Loop | None:
        """The trajectory behind a curve of a figure; None where none was stored."""
        law = self.laws.get(curve.law)
        return None if law is None else law.loop(scenario + (f"_hold{hold}" if hold else ""), curve.setting)

    # ------------------------------------------------------------------ for programs
    def validation(self) -> dict[str, Any]:
        """validation.json: figures by scenario and law, bounds, gate and titles."""
        scenarios: dict[str, dict[str, Any]] = {}
        for name in (n + end for end in ("", NOISE_SUFFIX) for n in self.scenarios):
            rows = {law: self._row(law, name) for law in self.laws if self.figure(law, name) is not None}
            if rows:
                scenarios[name] = rows
        return {
            "case": self.case.name,
            "best": self.best,
            "scenarios": scenarios,
            "bounds": {name: {k: dict(v) for k, v in kinds.items()} for name, kinds in self.bounds.items()},
            "gate": {
                "id": self._gate_id(),
                "weights": dict(self.case.gate),
                "floor": self.floor,
                "laws": {
                    law: {
                        "score": self.score(law),
                        "lock_ups": found.lock_ups,
                        "ratios": {s: r for s in self.case.gate if (r := self.gate_ratio(law, s)) is not None},
                    }
                    for law, found in self.laws.items()
                },
            },
            "titles": {
                "case": self.case.title,
                "laws": {name: law.title for name, law in self.laws.items()},
                "scenarios": self.scenarios,
            },
        }

    def _row(self, law: str, scenario: str) -> dict[str, Any]:
        row: dict[str, Any] = {metric: self.figure(law, scenario, metric) for metric in METRICS}
        row["seeds"] = self.laws[law].seeds
        for how in ("min", "max"):
            row[f"mae_{how}"] = self.figure(law, scenario, "mae", None, how)
        return row

    def _gate_id(self) -> str:
        """Digest of what the gate measures: scores of different ids may not be compared."""
        tests = self.case.scenarios()
        what: dict[str, Any] = {
            s: [w, self.bound(s), [t.digest() for t in tests.get(s, ())]] for s, w in self.case.gate.items()
        }
        what["floor"] = self.floor
        return hashlib.sha256(json.dumps(what, sort_keys=True).encode()).hexdigest()[:12]
