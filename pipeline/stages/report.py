"""Stage report: the paper's figures beside ours, for people and for programs."""

from __future__ import annotations

import hashlib
import sys
from pathlib import Path

from loopwright.pipeline.cases import all_cases, beside
from loopwright.pipeline.config.params import CaseParams, choose, entries, parse, read_section
from loopwright.pipeline.engine.command import run_stage
from loopwright.pipeline.evaluation.evidence import Evidence
from loopwright.pipeline.evaluation.verdicts import PLAIN
from loopwright.pipeline.files import write_json
from loopwright.pipeline.optimal.bounds import bounds_path, stored_bounds
from loopwright.pipeline.optimal.model_bounds import model_bounds
from loopwright.pipeline.report.page import write_report
from loopwright.pipeline.stages.paths import ARTIFACTS, TIMING, WORK, receipt_file


def report(name: str) -> None:
    """Write artifacts/<case>/{validation.json,report.html,report.md,figures/} from work/<case>."""
    params = parse(CaseParams, read_section("cases", name), f"cases.{name}")
    case = choose(all_cases(), name, "case", "cases").with_held_out(params.held_out_seeds)
    case.tests()  # raises where there are none
    # A new case has no bounds until `loopwright bounds` has run; stale ones are an error, never shown.
    bounds, missing = stored_bounds(case) if bounds_path(case).exists() else ({}, [])
    if case.on_models:
        bounds = model_bounds(case, WORK / name / "bounds.json")
    for line in missing or (
        [] if bounds or case.on_models else [f"no bounds yet; `loopwright bounds {name}` computes them"]
    ):
        print(f"report {name}: {line}", file=sys.stderr)
    laws, models = entries("controllers", name, "name"), entries("models", name, "model")
    own_data = any(_is_own(Path(data), name) for data in entries("models", name, "data"))
    evidence = Evidence.load(case, bounds, WORK / name, TIMING / name, laws, models, own_data)
    claims, pictures = beside(case, "paper", "CLAIMS", PLAIN), beside(case, "pictures", "PICTURES", ())
    files = write_report(evidence, claims, pictures, ARTIFACTS / name)
    print(f"report {name}: {len(files)} files in {ARTIFACTS / name}")
    verdicts = (ARTIFACTS / name / "validation.json").read_bytes()
    write_json(receipt_file(name), {"validation_sha256": hashlib.sha256(verdicts).hexdigest()})


def _is_own(data: Path, case: str) -> bool:
    """Whether models were learnt from a person's own file: neither a plant's text nor the case's experiments."""
    return data.suffix != ".py" and not data.is_relative_to(WORK / case)


if __name__ == "__main__":
    sys.exit(run_stage(report, sys.argv, "CASE"))
