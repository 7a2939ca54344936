"""Stage fit: a set of models a data seed."""

from __future__ import annotations

import shutil
import statistics
import sys
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from loopwright.pipeline.cases import all_cases, beside
from loopwright.pipeline.config.params import ModelParams, choose, parse
from loopwright.pipeline.engine.command import run_stage
from loopwright.pipeline.engine.parallel import parallel_map
from loopwright.pipeline.errors import ParamsError, PipelineError
from loopwright.pipeline.evaluation.case import Case
from loopwright.pipeline.evaluation.model_evidence import IDENTIFIED
from loopwright.pipeline.evaluation.proof import fit_doubts, sign_doubts, wants_a_plainer_model
from loopwright.pipeline.files import write_json
from loopwright.pipeline.models import MODELS, Part, Source
from loopwright.pipeline.models.part import Groundwork, done, groundworks
from loopwright.pipeline.records.record import Record
from loopwright.pipeline.stages.paths import model_folder

Shared = Mapping[int, Mapping[Groundwork[Any], Any]]
"""Data seed -> groundwork -> its result."""

Results = Mapping[tuple[int, str], tuple[str | None, dict[str, Any], Mapping[str, Any] | None]]
"""(data seed, part) -> digest of its record, figures, predictions."""


@dataclass(frozen=True, slots=True)
class Fits:
    """The parts of a set, each to be learnt on every data seed."""

    parts: Mapping[str, Part]
    data: Mapping[int, Path | None]
    case: Case

    def learnt(self, shared: Shared, folder: Path, label: str) -> Results:
        """Every part of every data seed, learnt with what they share, and saved in ``folder``."""
        work = [(seed, part) for seed in self.data for part in self.parts]
        learnt = parallel_map(
            partial(_learn, self, shared, folder),
            work,
            f"{label}: the models, their errors and their bands",
            in_folder=True,
        )
        return dict(zip(work, learnt, strict=True))

    def source(self, seed: int) -> Source:
        """Record, signals and plant that the parts of a data seed are learnt from."""
        path, case = self.data[seed], self.case
        record = None if path is None else Record.read(path, case.record_signals)
        return Source(record, case.plant.signals, case.regions, seed, case.plant, known=case.known, held=case.held)

    def figures(self, results: Results) -> dict[str, Any]:
        """Each part's figures, by data seed and their median."""
        found = {}
        for part, description in self.parts.items():
            per_seed = {str(seed): figures for (seed, name), (_, figures, _) in results.items() if name == part}
            fields = {k: getattr(description, k) for k in ("task", "horizon") if hasattr(description, k)}
            found[part] = {"kind": description.model.kind, **fields, "per_seed": per_seed, "median": _median(per_seed)}
        return found

    def proven_if_possible(self, shared: Shared, folder: Path, label: str) -> tuple[Results, dict[str, Any]]:
        """Results and figures; of an own plant with plainer models where the record proves these and no others.

        See ``wants_a_plainer_model``. One that misses the plant is not taken either.
        """
        results = self.learnt(shared, folder, label)
        figures = self.figures(results)
        found, plain = {"": {"parts": figures}}, _plainer(shared)
        proofs = self.case.on_models and self.case.stand_in == IDENTIFIED
        if not proofs or plain is None or not wants_a_plainer_model(found):
            return results, figures
        apart = folder / "plainer"
        try:
            again = self.learnt(plain, apart, f"{label}, linear, as the network is not proven")
            others = self.figures(again)
            found = {"": {"parts": others}}
            if sign_doubts(found) or fit_doubts(found):
                return results, figures
            shutil.copytree(apart, folder, dirs_exist_ok=True)
            return again, others
        except (PipelineError, np.linalg.LinAlgError):
            return results, figures
        finally:
            shutil.rmtree(apart, ignore_errors=True)


def fit(name: str) -> None:
    """Train the parts of ``models.<name>`` on each data seed; write them, metrics.json and the sweep."""
    params = ModelParams.read(name)
    case = choose(all_cases(), params.case, "case", f"models.{name}")
    parts = parts_of(params, f"models.{name}")
    folder = model_folder(params.case, params.model)
    shutil.rmtree(folder, ignore_errors=True)
    fits, label = Fits(parts, data_files(params.data), case), f"fit {name}"
    needed = groundworks(parts.values())
    shared = {seed: done(needed, fits.source(seed), label) for seed in fits.data if needed}
    results, figures = fits.proven_if_possible(shared, folder, label)
    digests = {str(seed): results[seed, next(iter(parts))][0] for seed in fits.data}
    write_json(folder / "metrics.json", {"model": params.model, "data": digests, "parts": figures})
    for part in parts if 0 in fits.data else ():
        predictions = results[0, part][2]
        if predictions is not None:
            np.savez(folder / "predictions.npz", **predictions)


def _plainer(shared: Shared) -> Shared | None:
    """Groundwork with simpler models wherever there is one; None where there is none at all."""
    found = {seed: {work: work.plainer(result) for work, result in of.items()} for seed, of in shared.items()}
    if not any(plain is not None for of in found.values() for plain in of.values()):
        return None
    return {
        seed: {work: shared[seed][work] if plain is None else plain for work, plain in of.items()}
        for seed, of in found.items()
    }


def parts_of(params: ModelParams, where: str) -> dict[str, Part]:
    """The descriptions of a set's parts by name; ParamsError says what of them cannot be."""
    kinds = {**MODELS, **beside(all_cases()[params.case], "models", "MODELS", {})}
    parts = {}
    for name, values in params.parts.items():
        place, options = f"{where}.parts.{name}", dict(values)
        kind = choose(kinds, options.pop("kind", None), "kind of part", f"{place}.kind")
        parts[name] = parse(kind, options, place)
    return parts


def data_files(data: Path) -> dict[int, Path | None]:
    """Data seed -> its file: a folder of seed<k>.parquet, one record of a plant, or a plant's text (no file)."""
    if data.suffix.lower() == ".py":
        return {0: None}
    if data.suffix.lower() in {".csv", ".parquet"}:
        return {0: data}
    files = {int(p.stem.removeprefix("seed")): p for p in data.glob("seed*.parquet")}
    if not files:
        raise ParamsError(
            f"data is {data}, which holds no seed<k>.parquet; give the folder of a record, a .csv or .parquet file, "
            "or a plant's .py"
        )
    return dict(sorted(files.items()))


def _learn(
    fits: Fits, shared: Shared, folder: Path, item: tuple[int, str]
) -> tuple[str | None, dict[str, Any], Mapping[str, Any] | None]:
    seed, name = item
    source = replace(fits.source(seed), groundwork=shared.get(seed, {}))
    learnt = fits.parts[name].learn(source)
    learnt.model.save(folder / f"seed{seed}" / f"{name}.npz")
    if learnt.sweep is not None:
        from loopwright.pipeline.pictures.model_pictures import draw  # here, because matplotlib takes a second to load

        learnt.sweep.save(folder / "sweep.json")
        draw(learnt.sweep, folder / "sweep.png")
    return None if source.record is None else source.record.digest(), learnt.metrics, learnt.predictions


def _median(per_seed: Mapping[str, Mapping[str, Any]]) -> dict[str, Any]:
    """Median of every number over the seeds that have it, nested mappings kept; lists and texts are left out."""
    rows = list(per_seed.values())
    medians: dict[str, Any] = {}
    for key in dict.fromkeys(key for row in rows for key in row):
        values = [row[key] for row in rows if key in row]
        nested = {str(i): value for i, value in enumerate(values) if isinstance(value, Mapping)}
        numbers = [value for value in values if isinstance(value, (int, float))]
        if nested:
            medians[key] = _median(nested)
        elif numbers:
            medians[key] = statistics.median(numbers)
    return medians


if __name__ == "__main__":
    sys.exit(run_stage(fit, sys.argv, "MODEL"))
