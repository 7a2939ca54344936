"""The pipeline or a part of it: says what will run and why, then runs it on one cluster of workers."""

from __future__ import annotations

import argparse
import json
import os
import signal
import subprocess
import sys
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from loopwright.pipeline.config.params import entries, sections, sections_of
from loopwright.pipeline.engine.cluster import STAGES as KINDS
from loopwright.pipeline.engine.dvc import affected, ask, ask_in_turn, end_with_parent, environment, hear_no_interrupt
from loopwright.pipeline.engine.run_mark import run_marked
from loopwright.pipeline.errors import ParamsError, PipelineError, nearest
from loopwright.pipeline.report.results import show_results, without_controller
from loopwright.pipeline.stages.check import mistakes
from loopwright.pipeline.stages.code import code as list_files
from loopwright.pipeline.stages.overview import brought_up

ARTIFACTS = Path("artifacts")
MANY_STAGES = 25  # stages that a person does not read line by line
STOPPED = {128 + number for number in (signal.SIGINT, signal.SIGTERM)}
ABSENT = {"deleted", "not in cache"}  # DVC's words for a file that is not there, whether or not it ever was
LISTS = "work/code/"  # of the files that each stage runs and reads, with their digests
# A kind of section of params.yaml -> the stages of each, in their order; the last one is what its name asks for.
STAGES = {"exports": ("screen",), "records": ("excite",), "models": ("fit",), "controllers": ("design", "validate")}


def options(parser: argparse.ArgumentParser) -> None:
    """Add the command's arguments."""
    parser.add_argument(
        "targets", metavar="TARGET", nargs="*", help="cases, controllers, models or records of params.yaml (all)"
    )
    parser.add_argument("--dry", action="store_true", help="say what would run and why, and run no stage")
    parser.add_argument("--keep-going", action="store_true", help="after a failure, run what does not depend on it")


def run(options: argparse.Namespace) -> int:
    """Check params.yaml, say what runs, run it, and show the results."""
    try:
        code = _run(options)
    except KeyboardInterrupt:
        code = 128 + signal.SIGINT
    if code in STOPPED:
        again = " ".join(["loopwright run", *options.targets])
        print(f"stopped; finished stages are kept, `{again}` goes on from there", file=sys.stderr)
    return code


def _run(options: argparse.Namespace) -> int:
    targets = [stage for name in options.targets for stage in stages_of(name)]
    wrong = mistakes()
    if wrong:
        rest = f"; params.yaml has {len(wrong)} mistakes, `loopwright check` lists them" if wrong[1:] else ""
        raise ParamsError(f"{wrong[0]}{rest}")
    # The list of files that each stage runs comes first: what has changed shows only after it.
    # DVC alone would not make it anew for a data file that has grown. It is told that this list is the stage's output:
    # it would run the stage once more, or put the list back that the same sources had before the file grew.
    # In a dry run it is not told, because that changes dvc.lock.
    list_files()
    if not options.dry:
        try:
            ask("commit", "--force", "code", finish=True)
        except PipelineError as error:
            raise PipelineError(
                f"the list of the files that each stage runs could not be made, so no stage ran ({error}); "
                f"mend that and run again: results are kept. Python is {sys.executable}; `make setup` gives one with "
                "all packages"
            ) from None
    found, graph = status(targets)
    expected = affected(graph, found, targets)
    changed = {stage: found[stage] for stage in sorted(found, key=(*expected, *found).index)}  # as they run
    print("\n".join(plan(changed, len(expected))), flush=True)
    if options.dry:
        return 0
    code = 0
    if changed:
        with run_marked():
            code = repro(targets, changed, expected, keep_going=options.keep_going)
    if code == 0:
        # Somebody who asked for one case need not look for it in the table of all.
        asked = options.targets if targets and all(t.startswith("report@") for t in targets) else [None]
        part = targets and not any(t.startswith("report") for t in targets)
        # The reports of some cases are no reason for DVC to make those of all, which the stage `overview` waits for.
        if targets and not part and brought_up():
            ask("commit", "--force", "overview", finish=True)
        if not part or any(ARTIFACTS.glob("*/validation.json")):
            for case in asked:
                show_results(ARTIFACTS, case=case)
        if part:
            print("the table is of the last report; `loopwright run CASE` makes the report of these results")
        # Who asks for a case asks for its controllers; the table says why there is none.
        code = int(any(case is not None and without_controller(ARTIFACTS, case) for case in asked))
    return code


def repro(targets: Sequence[str], changed: Iterable[str], expected: Sequence[str], *, keep_going: bool = False) -> int:
    """Run ``targets`` (none: everything), of which the stages ``changed``, by DVC; its exit status.

    ``expected`` are those and what depends on them. Cases share no output, so that those with changes run side by
    side. Stages find their libraries loaded once. The process that loads them imports nothing of the pipeline, so that
    every stage runs the sources as they are when it starts. It and all that it starts end with this process, whatever
    ends it, and after Ctrl-C; the status is then that of a shell, 130.
    """
    # What depends on a stage that failed must not run, and DVC knows that of its whole graph alone.
    chains = [] if keep_going else side_by_side(targets, changed)
    if chains:
        work = [*([] if targets else ["--rest"]), *(",".join(chain) for chain in chains)]
    else:
        work = ["repro", *(["--keep-going"] if keep_going else []), *targets]
    lanes = [sys.executable, "-m", "loopwright.pipeline.engine.parallel_dvc", "--of", ",".join(expected), *work]
    own, asked, running = os.getpid(), list[int](), list[subprocess.Popen[bytes]]()

    def begin() -> None:
        end_with_parent(own)
        hear_no_interrupt()

    def stop(number: int, _: object) -> None:
        asked.append(number)
        for process in running:
            process.terminate()

    before = {number: signal.signal(number, stop) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        command = [sys.executable, "-m", "loopwright.pipeline.engine.with_cluster", *lanes]
        kinds = ",".join(dict.fromkeys(stage.partition("@")[0] for stage in expected))
        with subprocess.Popen(command, env={**environment(), KINDS: kinds}, preexec_fn=begin) as process:
            running.append(process)
            if asked:
                process.terminate()
            code = process.wait()
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
    return 128 + asked[0] if asked and code else code


def side_by_side(targets: Sequence[str], changed: Iterable[str]) -> list[list[str]]:
    """The stages of each case that must run, in their order; none where fewer than two cases must, or parts of one.

    ``targets`` are the reports that are asked for, none: all cases. A case that reads another's record is no chain.
    """
    if not all(target.startswith("report@") for target in targets):
        return []
    asked = [target.partition("@")[2] for target in targets] or list(sections("cases"))
    touched = set(changed)
    chains = {case: chain for case in dict.fromkeys(asked) if touched.intersection(chain := chain_of(case))}
    read = {(case, Path(data).parts) for case in chains for data in entries("models", case, "data")}
    apart = all(parts[0] != "work" or parts[1] == case for case, parts in read)
    return list(chains.values()) if apart and len(chains) > 1 else []


def chain_of(case: str) -> list[str]:
    """The stages of a case, each after those that it depends on."""
    own = [f"{s}@{name}" for kind, stages in STAGES.items() for s in stages for name in sections_of(kind, case)]
    return [*own, f"report@{case}"]


def stages_of(name: str) -> list[str]:
    """The DVC stages that a name asks for: of a case its report, of a controller its validation.

    Raises ParamsError for a name that params.yaml does not have.
    """
    if name in sections("cases"):
        return [f"report@{name}"]
    for kind, stages in STAGES.items():
        if name in sections(kind):
            return [f"{stages[-1]}@{name}"]
    known = [name for kind in ("cases", *STAGES) for name in sections(kind)]
    hint, cases = nearest(name, known).partition(" known:")[0], ", ".join(sections("cases"))
    raise ParamsError(
        f"params.yaml has no case, controller, model or record {name!r}{hint} cases: {cases}; it lists the others"
    )


def status(targets: Iterable[str]) -> tuple[Mapping[str, list[str]], str]:
    """Stage -> why it runs, of the stages whose own files or parameters have changed; the graph of all stages.

    These are what ``dvc status`` and ``dvc dag --dot`` say.
    """
    upstream = [] if not targets else ["--with-deps"]
    said, graph = ask_in_turn(["status", "--json", *upstream, *targets], ["dag", "--dot"])
    tree = json.loads(said or "{}")
    return {stage: reasons(entries) for stage, entries in tree.items() if stage != "code"}, graph


def reasons(entries: Iterable[Mapping[str, Mapping[str, Any]] | str]) -> list[str]:
    """Reasons of DVC for a stage, in words: ``[{"changed deps": {"params.yaml": {"x.y": "modified"}}}]``."""
    lines = []
    for entry in entries:
        if isinstance(entry, str):  # "changed command", "always changed"
            lines.append(entry)
            continue
        if ABSENT.intersection(entry.get("changed outs", {}).values()):
            return ["never run here, or its results were removed"]
        for items in entry.values():
            for name, how in items.items():
                if name.startswith(LISTS):
                    lines.append("its code has changed, or a file that it reads")
                    continue
                # Parameters of a file have a word each.
                words = how if isinstance(how, Mapping) else {name: "not there" if how in ABSENT else how}
                lines += [f"{key} is {word}" for key, word in words.items()]
    return lines


def plan(changed: Mapping[str, list[str]], expected: int) -> list[str]:
    """Stages that have changed and why, a line each; of many stages, a line for each kind.

    ``expected`` counts them and what depends on them; a stage whose inputs come out the same does not run.
    """
    if not changed:
        return ["nothing has changed; everything is up to date"]
    stages = "1 stage has" if len(changed) == 1 else f"{len(changed)} stages have"
    head = f"{stages} changed; with what depends on that at most {expected} run. Changed:"
    if len(changed) > MANY_STAGES:
        kinds = Counter(stage.partition("@")[0] for stage in changed)
        return [head, *(f"  {kind:10} {count:3}" for kind, count in kinds.items())]
    width = max(map(len, changed))
    return [head, *(f"  {stage:{width}}  {'; '.join(why)}" for stage, why in changed.items())]
