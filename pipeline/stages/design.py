"""Stage design: one exported controller a data seed, and one for every variant of its numbers."""

from __future__ import annotations

import platform
import shutil
import sys
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

from loopwright.pipeline.cases import all_cases
from loopwright.pipeline.config.params import ControllerParams, choose, parse
from loopwright.pipeline.engine.command import reason, run_stage
from loopwright.pipeline.engine.fingerprint import commit
from loopwright.pipeline.engine.parallel import parallel_map
from loopwright.pipeline.errors import LawError, PipelineError, WithheldError
from loopwright.pipeline.evaluation.case import Case
from loopwright.pipeline.evaluation.law_evidence import BASE
from loopwright.pipeline.evaluation.model_evidence import IDENTIFIED
from loopwright.pipeline.evaluation.proof import question, sign_doubts
from loopwright.pipeline.export.explain_graph import export_explanation
from loopwright.pipeline.export.gate import export
from loopwright.pipeline.files import digest, read_json, write_json
from loopwright.pipeline.laws import LAWS, ControlLaw
from loopwright.pipeline.laws.suitability import require_fit
from loopwright.pipeline.models import load_model
from loopwright.pipeline.models.base import Model
from loopwright.pipeline.plants.simulator import Array, Simulator
from loopwright.pipeline.stages.paths import (
    analysis_file,
    calm_file,
    controller_file,
    design_folder,
    model_folder,
    old_loop_file,
)
from loopwright.serving.explain.explain_file import explain_path

REFUSALS = (PipelineError, np.linalg.LinAlgError)
"""Errors of a law that a plant does not suit; any other error is a mistake in the program."""


def design(name: str) -> None:
    """Export ``controllers.<name>`` for each seed of its model set, its variants too.

    On an own plant, a law that cannot be designed leaves the reason, and the other controllers go on.
    """
    params = ControllerParams.read(name)
    where = f"controllers.{name}"
    case, law = choose(all_cases(), params.case, "case", where), choose(LAWS, params.law, "law", where)
    forms = {BASE: params.settings, **{v: {**params.settings, **s} for v, s in params.variants.items()}}
    read = {form: parse(law.Params, settings, where) for form, settings in forms.items()}
    models = model_folder(params.case, params.model)
    seeds = sorted(int(p.name.removeprefix("seed")) for p in models.glob("seed*"))
    if not seeds:
        raise LawError(f"{where}: {models} holds no models; run the fit stage of that model set first")
    folder = design_folder(params.case, params.name)
    shutil.rmtree(folder, ignore_errors=True)
    fitted = read_json(models / "metrics.json")
    data = fitted.get("data", {})
    provenance = {"params_sha256": digest(forms), "commit": commit(), "versions": _versions()}
    work = [(form, seed) for form in forms for seed in seeds]
    arguments = (params, read, models, case.plant, provenance, data)
    label = f"design {name}: controllers, tuned and written as ONNX files"
    try:
        _require_proof(law, case, fitted)
        _require_fit(law, case)
        rows = parallel_map(partial(_export, *arguments, withhold=case.on_models), work, label, in_folder=True)
    except WithheldError as error:
        _withhold(folder, law, str(error))
        # Of the old loop neither speaks: it is no product.
        why = str(error) if params.name == case.old_loop else "the results and the report say why"
        print(f"design {name}: withheld; {why}", file=sys.stderr)
        return
    if case.old_loop not in ("", params.name):
        _export_old_loop(params, case, models, seeds, provenance)
    write_json(folder / "metrics.json", {"law": params.law, "title": law.title, "controllers": rows})


def _export_old_loop(
    of: ControllerParams, case: Case, models: Path, seeds: Sequence[int], provenance: Mapping[str, Any]
) -> None:
    """Put the loop that the plant was run by before beside the files of ``of``; one that cannot be made is left out.

    Its own stages make it too, which need not have run when those files are tested.
    """
    old = ControllerParams.read(f"{of.case}-{case.old_loop}")
    law = choose(LAWS, old.law, "law", f"controllers.{old.case}-{old.name}")
    settings = parse(law.Params, old.settings, f"controllers.{old.case}-{old.name}")
    for seed in seeds:
        try:
            made = law.design(settings, _parts(models, seed), case.plant.signals, case.plant).eval()
            path = old_loop_file(of.case, of.name, seed)
            export(made, path, case=of.case, provenance=provenance, drive=_closed_loop(case.plant))
        except REFUSALS:
            return


def _parts(models: Path, seed: int) -> dict[str, Model]:
    """The models of a data seed by the names of their parts."""
    return {p.stem: load_model(p) for p in sorted((models / f"seed{seed}").glob("*.npz"))}


def _require_proof(law: type[ControlLaw], case: Case, fitted: Mapping[str, Any]) -> None:
    """Raise WithheldError where the record does not prove the sign of the model that the law rests on.

    Its tests would run on models of the same record, wrong like this one, and find nothing. A simulator of the plant
    tells a wrong model itself; but what an engineer knows, and the record is certain to contradict, is asked first.
    """
    doubts = sign_doubts if case.stand_in == IDENTIFIED else question
    if case.on_models and (why := doubts({"": fitted})):
        raise WithheldError(f"law {law.name!r} is withheld: it is {why}")


def _require_fit(law: type[ControlLaw], case: Case) -> None:
    """Raise WithheldError where the law does not suit the case's plant."""
    try:
        require_fit(law, case.plant)
    except LawError as error:
        raise WithheldError(str(error)) from error
    except REFUSALS as error:
        if not case.on_models:
            raise
        raise WithheldError(_why(law.name, error)) from error


def _why(law: str, error: Exception) -> str:
    if isinstance(error, np.linalg.LinAlgError):
        # The stage's own words for it are about plants in equations.
        words = " ".join(str(error).split())
        return f"law {law!r} is withheld: its equations have no single solution over the model of the plant ({words})"
    return f"law {law!r} is withheld: {reason(error)}"


def _withhold(folder: Path, law: type[ControlLaw], why: str) -> None:
    """Leave the reason for which a law has no controllers, and nothing else."""
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    write_json(folder / "metrics.json", {"law": law.name, "title": law.title, "withheld": why})


def _export(
    params: ControllerParams,
    forms: Mapping[str, Any],
    models: Path,
    plant: Simulator,
    provenance: Mapping[str, Any],
    data: Mapping[str, str],
    item: tuple[str, int],
    *,
    withhold: bool,
) -> dict[str, Any]:
    """The row of one exported file; with ``withhold``, WithheldError for what the law cannot do with its models."""
    form, seed = item
    parts = _parts(models, seed)
    path = controller_file(params.case, params.name, form, seed)
    origin = {**provenance, "data_seed": seed, "record_sha256": data.get(str(seed))}
    try:
        law = LAWS[params.law].design(forms[form], parts, plant.signals, plant).eval()
        export(law, path, case=params.case, provenance=origin, drive=_closed_loop(plant))
        export_explanation(law, path)
        row = {"form": form, "seed": seed, "bytes": path.stat().st_size, "n_state": law.n_state}
        row |= _analysed(law, plant, analysis_file(params.case, params.name, form, seed))
        if withhold and form == BASE:
            row |= _export_calmer(params, law, seed, plant, origin)
        return row
    except REFUSALS as error:
        if not withhold:
            raise  # who wrote equations and a law down wants to know
        raise WithheldError(_why(params.law, error)) from error


def _export_calmer(
    params: ControllerParams, law: ControlLaw, seed: int, plant: Simulator, origin: Mapping[str, Any]
) -> dict[str, Any]:
    """The entry ``calmed`` of a file's row, of the law with calmer numbers beside it; {} where these cannot be made.

    The law itself is made already, and is not withheld because its last resort cannot be.
    """
    path = calm_file(params.case, params.name, seed)
    try:
        calm = law.calmed()
        if calm is None:
            return {}
        export(calm.eval(), path, case=params.case, provenance=origin, drive=_closed_loop(plant))
        export_explanation(calm, path)
        return {"calmed": _analysed(calm, plant, None)}
    except REFUSALS:
        path.unlink(missing_ok=True)
        explain_path(path).unlink(missing_ok=True)
        return {}


def _analysed(law: ControlLaw, plant: Simulator, path: Path | None) -> dict[str, Any]:
    """The law's own analysis, its arrays in a file of their own if there is to be one; {} of a law that has none."""
    analysis = law.analysis(plant)
    if analysis.arrays and path is not None:
        arrays: dict[str, Any] = {name: np.asarray(array) for name, array in analysis.arrays.items()}
        np.savez_compressed(path, **arrays)
    words: dict[str, Any] = {"figures": _floats(analysis.figures), "notes": list(analysis.notes)}
    if analysis.table:
        words["table"] = [_floats(row) for row in analysis.table]
    return {"analysis": words} if any(words.values()) else {}


def _floats(figures: Mapping[str, float]) -> dict[str, float]:
    return {name: float(value) for name, value in figures.items()}


def _closed_loop(plant: Simulator) -> Callable[[Array], Array]:
    """The plant as the parity gate drives it: one period further with each MV."""
    state, _ = plant.start
    step, measure, dv, p = plant.stepper(), plant.meter(), plant.dv_nominal, plant.parameters()

    def drive(mv: Array) -> Array:
        nonlocal state
        state = step(state, mv, dv, p)
        return measure(state)

    return drive


def _versions() -> dict[str, str]:
    names = ("loopwright", "torch", "onnx", "onnxruntime")
    return {"python": platform.python_version(), "numpy": np.__version__, **{n: version(n) for n in names}}


if __name__ == "__main__":
    sys.exit(run_stage(design, sys.argv, "CONTROLLER"))
