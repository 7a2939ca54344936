"""Stage code: ``python -m loopwright.pipeline.stages.code`` lists the files that every other stage runs.

work/code/<stage>-<case>.json (<stage>.json of a stage over all cases) holds the sha256 of each file
of ``pipeline`` and ``serving`` that the stage imports, at whatever depth, without its comments; of the data files that
dvc.yaml cannot list (exports, simulators); and the digest of what a report, or a stage of an own plant, reads of
params.yaml beside its section. The stage depends on that one file, so an edit runs again what it has a part in and
nothing else. One file for each stage keeps dvc.lock short, which DVC reads and writes after every stage.
"""

from __future__ import annotations

import hashlib
import re
import sys
from functools import cache
from itertools import product
from pathlib import Path
from typing import Any

import grimp

from loopwright.pipeline.cases import all_cases
from loopwright.pipeline.config.exports import ExportParams, is_exported
from loopwright.pipeline.config.params import entries, read_section, sections
from loopwright.pipeline.config.plants import PlantParams
from loopwright.pipeline.engine.command import run_stage
from loopwright.pipeline.engine.fingerprint import FOLDERS, IMPORTED, digest_of_sources
from loopwright.pipeline.engine.stage_files import DATA, EVERY
from loopwright.pipeline.errors import PipelineError
from loopwright.pipeline.evaluation.evidence_basis import SCREENING
from loopwright.pipeline.files import digest, sha256, write_json
from loopwright.pipeline.records.record_file import SET_POINTS
from loopwright.pipeline.stages.paths import WORK

PIPELINE, SERVING = PACKAGES = ("loopwright.pipeline", "loopwright.serving")
STAGES = ("screen", "excite", "fit", "design", "validate", "report")  # of one case each
LAST = ("overview", "publish")


def _of(package: str, *names: str) -> tuple[str, ...]:
    """Modules of a package by their full names."""
    return tuple(f"{package}.{name}" for name in names)


# What carries a stage's work from place to place and has no part in its result.
CARRIERS = (
    *(PIPELINE, *_of(PIPELINE, "config", "engine", "errors", "files", "stages.paths")),
    *(SERVING, *_of(SERVING, "errors")),
)
# A stage asks a case for its plant before it is validated: which tests the case has changes nothing.
TESTS = _of(PIPELINE, "evaluation", "simulation.scenario")
# Stage -> what it imports without a part in its result: by whom ("" is anybody), and what, with all that is in it.
APART = {
    "excite": {("", what) for what in (*TESTS, *_of(SERVING, "manifest"))},
    "fit": {
        *(("", what) for what in (*_of(PIPELINE, "simulation.scenario"), *_of(SERVING, "manifest"))),
        *((who, f"{PIPELINE}.evaluation") for who in _of(PIPELINE, "cases", "models", "pictures")),
        # A fit asks whether the record proves its model: the words of that have no part in the answer.
        (f"{PIPELINE}.stages", f"{PIPELINE}.evaluation.case"),
        (f"{PIPELINE}.evaluation", f"{PIPELINE}.evaluation.validation"),
    },
    "design": {
        *(("", what) for what in TESTS),
        # What trained the models has had its effect.
        *((f"{PIPELINE}.models", what) for what in _of(PIPELINE, "metrics", "records", "historian")),
        # The parity gate says whether the runtime agrees with the law, and changes nothing.
        *(("", what) for what in _of(SERVING, "controller", "graph")),
    },
}
# Stage -> the modules beside case.py that it loads.
BESIDE = {"excite": ("excitations",), "fit": ("models",), "report": ("paper", "pictures")}
# Entries of params.yaml that a report goes by: section and field.
LISTED = (("controllers", "name"), ("models", "model"), ("models", "data"))
BEFORE_LAWS = ("screen", "excite", "fit")
# Files that are read and not imported.
TEMPLATES = dict.fromkeys(("report", "overview"), "*") | {"screen": "screening*"}
# A text first, so that no comment is found inside of one. The tokenizer takes two seconds for all sources.
_TEXT_OR_COMMENT = re.compile(
    r"""(?P<text>(?P<three>\"{3}|'{3})(?:\\.|.)*?(?P=three)|"(?:\\.|[^"\\\n])*"|'(?:\\.|[^'\\\n])*')"""
    r"""|^[ \t]*\#[^\n]*\n|[ \t]*\#[^\n]*""",
    re.MULTILINE | re.DOTALL,
)
NO_FILE = "not there"  # in place of a digest; the stage says so


def code() -> None:
    """Write work/code: one file for each stage of each case, one for each of those at the end; no other stays there."""
    check_sources(Path.cwd())
    made = {DATA}
    for stage, case in (*((stage, "") for stage in LAST), *product(STAGES, all_cases())):
        if stage == "screen" and not is_exported(case):
            continue
        made.add(file := WORK / "code" / f"{stage}{case and '-' + case}.json")
        write_json(file, listing(Path.cwd(), stage, case))
    # For the engine, which sends a stage's files to a worker: no stage depends on this list.
    simulators = {p.as_posix() for case in all_cases().values() for p in case.reads}  # the list of cases loads them all
    found = {name: PlantParams.read(name).data for name in sections("plants")}
    # A verdict that is not there, as of a record of one's own, is not sent.
    beside_it = (SCREENING, SET_POINTS)
    records = {n: [p.as_posix() for p in (data, *map(data.with_name, beside_it))] for n, data in found.items()}
    write_json(DATA, {EVERY: sorted(simulators), **records})
    for left in set((WORK / "code").glob("*.json")) - made:  # of a case or an export that is no more
        left.unlink()


def check_sources(root: Path) -> None:
    """Raise PipelineError where ``root`` has other sources than those that run: results would be filed under them."""
    if not all((root / folder).is_dir() for folder in FOLDERS) or root.resolve() == IMPORTED.resolve():
        return
    if digest_of_sources(root) != digest_of_sources(IMPORTED):
        raise PipelineError(
            f"the sources in {root} are not those that run, which are in {IMPORTED}: install these (make setup here), "
            "or set PYTHONPATH to their tools/roots"
        )


def listing(root: Path, stage: str, case: str = "") -> dict[str, str]:
    """Path -> sha256 of every file that the stage runs or reads (for the case)."""
    files = {path_of(root, module) for module in modules(stage, case)}
    if stage in TEMPLATES:
        files |= set((root / "pipeline/report/templates").glob(TEMPLATES[stage]))
    bounds = path_of(root, beside(case, "bounds")).with_suffix(".json") if stage == "report" else root
    if bounds.is_file():
        files.add(bounds)
    found = {p.relative_to(root).as_posix(): _digest_of(p) for p in sorted(files)}
    data = _data_of(stage, case)
    found |= {p.as_posix(): sha256(root / p) if (root / p).is_file() else NO_FILE for p in data}
    read = _read_of(stage, case)
    return {**found, "params.yaml": digest(read)} if read else found


def _digest_of(path: Path) -> str:
    """sha256 of a file; of a Python file without its comments, which change no result."""
    if path.suffix != ".py":
        return sha256(path)
    return hashlib.sha256(without_comments(path.read_text(encoding="utf-8")).encode()).hexdigest()


def without_comments(source: str) -> str:
    """Python source without its comments, and without the lines that are nothing else; texts stay as they are."""
    return _TEXT_OR_COMMENT.sub(lambda found: found["text"] or "", source)


def _data_of(stage: str, case: str) -> tuple[Path, ...]:
    """Data files that dvc.yaml cannot list, because their number differs from plant to plant."""
    if stage == "screen":
        return ExportParams.read(case).files
    return all_cases()[case].reads if stage == "validate" else ()


def _read_of(stage: str, case: str) -> list[Any]:
    """Keys of params.yaml that a stage reads beside its own section.

    A stage of an own plant reads its signals; a fit which way the loop that it was run by before acts; a design that
    loop, which stands beside each controller; whatever follows a fit the ranges within which set points are drawn; a
    report the case too, and which controllers and models it lists.
    """
    if not case:
        return []
    own = [_plant_of(stage, case)] if case in sections("plants") else []
    if stage == "design" and (old := all_cases()[case].old_loop):
        own.append(read_section("controllers", f"{case}-{old}"))
    if stage == "fit" and (held := all_cases()[case].held):
        own.append(dict(held))
    if stage not in BEFORE_LAWS and (kept := all_cases()[case].kept_ranges):
        own.append({pv: list(ends) for pv, ends in kept.items()})
    if stage != "report":
        return own
    case_and_plant = [*([read_section("cases", case)] if case in sections("cases") else []), *own]
    return [*case_and_plant, *(list(entries(kind, case, field)) for kind, field in LISTED)]


def _plant_of(stage: str, case: str) -> dict[str, Any]:
    """``plants.<case>`` as far as the stage goes by it: how fast an MV may move changes neither record nor models."""
    plant = read_section("plants", case)
    if stage not in BEFORE_LAWS:
        return plant
    mvs = [{key: value for key, value in mv.items() if key != "max_move_per_min"} for mv in plant.get("mv", ())]
    # What is known of pairs decides models, and no record.
    return {key: value for key, value in {**plant, "mv": mvs}.items() if stage != "screen" or key != "known"}


def modules(stage: str, case: str = "") -> set[str]:
    """The modules that have a part in the stage's result, by what imports what."""
    imports = graph()
    reached: set[str] = set()
    todo = [f"{PIPELINE}.stages.{stage}"]
    if case and stage != "screen":  # which knows no case, only its files
        own = [beside(case, name) for name in ("case", *BESIDE.get(stage, ()))]
        todo += [module for module in own if module in imports.modules]
    while todo:
        module = todo.pop()
        reached.add(module)
        # The list of cases imports them all; this stage runs its own alone.
        used = imports.find_modules_directly_imported_by(module) if module != f"{PIPELINE}.cases" else set()
        todo += [m for m in used - reached if not _within(m, CARRIERS) and not _apart(stage, module, m)]
    return reached


@cache
def graph() -> grimp.ImportGraph:
    """All imports among the modules, wherever they stand in the text."""
    return grimp.build_graph(*PACKAGES, cache_dir=None)


def beside(case: str, name: str) -> str:
    """The module ``name`` beside the case's own: paper_15s beside case_15s."""
    package, _, own = type(all_cases()[case]).__module__.rpartition(".")
    return f"{package}.{own.replace('case', name, 1)}"


def path_of(root: Path, module: str) -> Path:
    """The file of a module, whether there or not; of a package its __init__.py.

    A folder of what Python compiled once is no package: a module may have taken its place since.
    """
    path = root.joinpath(*module.split(".")[1:])  # the folders lie at the root
    package = path / "__init__.py"
    return package if package.exists() else path.with_suffix(".py")


def _apart(stage: str, importer: str, imported: str) -> bool:
    return any(importer.startswith(who) and _within(imported, (what,)) for who, what in APART.get(stage, ()))


def _within(module: str, packages: tuple[str, ...]) -> bool:
    return any(module == p or (module.startswith(p + ".") and p not in PACKAGES) for p in packages)


if __name__ == "__main__":
    sys.exit(run_stage(code, sys.argv))
