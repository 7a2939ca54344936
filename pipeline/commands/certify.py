"""``loopwright certify``: a bound on the share of plants on which a controller file fails, fixed beforehand."""

from __future__ import annotations

import argparse
import dataclasses
import json
import shlex
import time
from pathlib import Path
from typing import Any

from loopwright.pipeline.commands.arguments import case_of, real, require_shipped, whole
from loopwright.pipeline.commands.stress import loop_options
from loopwright.pipeline.config.params import (
    MOST_CONFIDENCE,
    PARAMS_FILE,
    CaseParams,
    CertificateParams,
    parse,
    read_section,
    sections,
)
from loopwright.pipeline.errors import ParamsError
from loopwright.pipeline.evaluation.case import Case
from loopwright.pipeline.evaluation.certificate.plan import CertificatePlan, plan_again
from loopwright.pipeline.evaluation.stress.batches import outcomes_of
from loopwright.pipeline.evaluation.stress.loops import Stress, opened
from loopwright.pipeline.export.controller_file import with_evidence
from loopwright.pipeline.export.plain_code.compiled_law import law_stepping
from loopwright.pipeline.files import read_json, write_json
from loopwright.pipeline.report.stress import replay_loop
from loopwright.serving.certificate import CERTIFICATE, Certificate, certificate_of, loops_without_failure
from loopwright.serving.controller import Controller

CERTIFIED_LOOPS = loops_without_failure(0.01, 0.99)
PLAN_FILE, RESULT_FILE = "plan.json", "certificate.json"
LIMIT = "NAME=VALUE"


def options(parser: argparse.ArgumentParser) -> None:
    """Add the command's arguments."""
    add = parser.add_argument
    percent = real("a percentage from 0 to 100", lambda value: 0 <= value <= 100)
    sure = real(f"a percentage from 50 to {MOST_CONFIDENCE}", lambda value: 50 <= value <= MOST_CONFIDENCE)
    add("file", metavar="CONTROLLER", type=Path, help="a controller's .onnx file")
    add("--loops", metavar="N", type=whole(1), default=CERTIFIED_LOOPS,
        help=f"closed loops ({CERTIFIED_LOOPS}: none may fail for 1 %%; 4603: for .1 %%)")  # fmt: skip
    add("--confidence", metavar="PERCENT", type=sure, help="of the bound (99)")
    add("--spread", metavar="PERCENT", type=percent, help="of parameters for which the case states no range (2)")
    add("--faults", metavar="PERCENT", type=percent, help="share of the loops with a fault of an actuator (50)")
    add("--limit", metavar=LIMIT, type=_limit, action="append",
        help="a loop fails too whose figure is larger, as mae=0.5; may be given again")  # fmt: skip
    add("--swings", action="store_true", default=None, help="a loop fails too that swings to the end")
    add("--plan-only", action="store_true", help="write the plan, and run nothing yet")
    add("--out", metavar="FOLDER", type=Path, help="of plan, certificate and certified file (CASE-LAW-certificate)")
    loop_options(parser)
    add("--replay", metavar="K", type=whole(0), help="run one loop of the file's certificate again, and draw it")


def run(options: argparse.Namespace) -> None:
    """Write the plan, run its loops, and write the file with its certificate; or run one loop again."""
    require_shipped(options.file)
    controller, content = opened(options.file)
    case = case_of(controller.manifest)
    out = options.out or Path(f"{case.name}-{options.file.stem}-certificate")
    if options.replay is not None:
        _replay(options, controller, content, case, out)
        return
    target = out / options.file.name
    if target.resolve() == options.file.resolve():
        raise ParamsError(f"{target} is the file itself, and the certified file is a copy; name a folder by --out")
    plan = CertificatePlan(controller.law_sha256, *_asked(options, case))
    stepping = law_stepping(controller, options.law_by)
    _write_plan(plan, controller, out)
    print(f"plan {plan.sha256[:16]}..., fixed before the first loop: {out / PLAN_FILE}")
    if options.plan_only:
        return
    stress = Stress(plan.drawing(), content, compute=stepping.compute)
    begun = time.perf_counter()
    outcomes = outcomes_of(stress, plan.params.loops, options.batch, options.workers, "certify: batches of loops")
    taken = time.perf_counter() - begun
    found = plan.certificate(outcomes, stepping.words)
    with_evidence(options.file, target, {**controller.manifest.evidence, CERTIFICATE: found.to_dict()})
    every = {str(o.index): list(how) for o in outcomes if (how := plan.failures(o))}
    write_json(out / RESULT_FILE, {**found.to_dict(), "failed": every, "replay": _replay_command(target, "K")})
    print(f"{plan.params.loops} loops in {taken:.1f} s, the law stepped by {stepping.words}")
    print(*found.lines, sep="\n")
    if every:
        print(f"one of them again: {_replay_command(target, next(iter(every)))}")
    print(f"certified file: {target}" + _to_sign(options.file, target))


def _asked(options: argparse.Namespace, case: Case) -> tuple[Case, CertificateParams]:
    """The case and what its certificate rests on: ``cases.<case>`` of params.yaml, where there is one, and options."""
    known = CertificateParams()
    if PARAMS_FILE.exists() and case.name in sections("cases"):
        choices = parse(CaseParams, read_section("cases", case.name), f"cases.{case.name}")
        case, known = case.with_held_out(choices.held_out_seeds), choices.certificate
    given: dict[str, Any] = {
        name: value
        for name in ("loops", "confidence", "spread", "faults", "swings")
        if (value := getattr(options, name)) is not None
    }
    if options.limit:
        given["limits"] = dict(options.limit)
    try:
        return case, dataclasses.replace(known, **given)
    except ValueError as error:
        raise ParamsError(str(error)) from None


def _write_plan(plan: CertificatePlan, controller: Controller, out: Path) -> None:
    """Write the plan; ParamsError where the folder holds another plan, or something else."""
    path = out / PLAN_FILE
    if out.exists() and not out.is_dir():
        raise ParamsError(f"{out} is no folder; name one by --out")
    if path.exists():
        first = read_json(path)
        if first.get("plan") == plan.sha256:
            return
        raise ParamsError(
            f"{path} holds another plan, which was fixed first ({first.get('loops')} loops of the law "
            f"{str(first.get('law'))[:12]}...): give its options, or name another folder by --out"
        )
    out.mkdir(parents=True, exist_ok=True)
    file = {"name": controller.path.name, "sha256": controller.sha256}
    written = time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime())
    write_json(path, {**plan.record(), "file": file, "written": written})


def _replay(options: argparse.Namespace, controller: Controller, content: bytes, case: Case, out: Path) -> None:
    """Run one loop of the file's certificate again, say what was drawn and how it went, and draw it."""
    certificate = _certificate_in(controller)
    if options.replay >= certificate.loops:
        raise ParamsError(f"--replay is {options.replay}; the certificate has the loops 0 to {certificate.loops - 1}")
    plan = plan_again(certificate, case)
    stepping = law_stepping(controller, options.law_by)
    stress = Stress(plan.drawing(), content, compute=stepping.compute)
    print(*replay_loop(stress, options.replay, out / f"loop_{options.replay}.png"), sep="\n")
    print(f"law stepped by {stepping.words}")
    then = ", ".join(certificate.failed.get(str(options.replay), ()))
    listed = then or certificate.failures == len(certificate.failed)
    print(f"when the certificate was made: {(then or 'no failure') if listed else 'not listed'}")
    print(f"stepped then by {certificate.stepped_by}")


def _certificate_in(controller: Controller) -> Certificate:
    """The certificate of a file; ParamsError where there is none to believe."""
    read = certificate_of(controller.manifest, controller.law_sha256)
    if read.certificate is None:
        why = f"its certificate counts for nothing: {read.wrong}" if read.wrong else "it holds no certificate"
        raise ParamsError(f"{controller.path}: {why}; give the file that `loopwright certify` wrote")
    return read.certificate


def _replay_command(file: Path, loop: str) -> str:
    return f"loopwright certify {shlex.quote(str(file))} --replay {loop}"


def _to_sign(file: Path, target: Path) -> str:
    """Advice to sign the certified file where the other one is signed: its signature is that of other bytes."""
    signature = file.with_name(f"{file.name}.sig")
    if not signature.exists():
        return ""
    return f"\nthe file is signed, its certified copy not yet: loopwright sign {shlex.quote(str(target))} --key KEY"


def _limit(text: str) -> tuple[str, float]:
    name, equals, value = text.partition("=")
    try:
        if not (name and equals):
            raise ValueError
        return name, float(json.loads(value))
    except (ValueError, TypeError):
        raise argparse.ArgumentTypeError(f"{text!r} is not of the form {LIMIT}") from None
