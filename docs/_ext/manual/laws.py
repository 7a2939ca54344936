"""Laws: what a law needs, suits and tells, from its class; the names of its info."""

from __future__ import annotations

import json
import re
import tomllib
from functools import cache
from pathlib import Path
from typing import Any

from loopwright.pipeline.cases import CASES
from loopwright.pipeline.evaluation.validation import FILE, Validation
from loopwright.pipeline.laws import LAWS, ControlLaw
from manual.markdown import code, prose, table
from manual.parameters import whole

ROOT = Path(__file__).parents[3]
INFO = Path(__file__).with_name("info.toml")
"""Info name -> unit and words; ``NAME`` stands for a signal's name."""


@cache
def told() -> dict[str, dict[str, str]]:
    """``INFO``, read once."""
    return tomllib.loads(INFO.read_text(encoding="utf-8"))


@cache
def shipped() -> dict[str, list[tuple[str, str, dict[str, Any]]]]:
    """Law -> (case, controller, manifest) of each file in ``artifacts``; a person's own plants are left out."""
    found: dict[str, list[tuple[str, str, dict[str, Any]]]] = {}
    for path in sorted((ROOT / "artifacts").glob("*/*.json")):
        row = json.loads(path.read_text(encoding="utf-8"))
        if "law" in row and path.parent.name in CASES:
            found.setdefault(row["law"], []).append((path.parent.name, path.stem, row))
    return found


def pattern_of(name: str) -> str:
    """The info name with ``NAME`` in the place of a signal's name."""
    if name in told():
        return name
    for pattern in told():
        if "NAME" in pattern and re.fullmatch(pattern.replace("NAME", ".+"), name):
            return pattern
    return name


def info_of(law: str) -> list[str]:
    """The info names that shipped controllers of the law have, each once."""
    names = [pattern_of(name) for _, _, manifest in shipped().get(law, []) for name in manifest["info"]]
    return list(dict.fromkeys(names))


def facts(name: str) -> str:
    """The facts that the class states of a law: needs, plants that it suits, parameters, info."""
    law = LAWS[name]
    rows = [
        ("name in params.yaml", code(name)),
        ("model set", _needs(law)),
        ("variables", "one controlled variable by one MV" if law.one_loop else "one or several"),
        ("transfer from manual", _transfer(law)),
        ("dead time", _dead_time(law)),
        ("source", f"[`{_path(law)}`](../../{_path(law)})"),
    ]
    shown = [f"| {code(n)} | {told()[n]['unit']} | {prose(told()[n]['words'])} |" for n in info_of(name)]
    info = "\n".join(["| info | unit | meaning |", "| --- | --- | --- |", *shown])
    return "\n\n".join(
        [
            table(["", ""], rows),
            "## Parameters",
            "`_s` in a name: seconds. `None` leaves the choice to the law. A default such as `0.02 * range` is a "
            "share of the controlled variable's range.",
            whole(law.Params),
            "## What it tells",
            info,
        ]
    )


def _needs(law: type[ControlLaw]) -> str:
    return "; ".join(f"{code(part)}: {prose(words)}" for part, words in law.parts.items()) or "no part is required"


def _transfer(law: type[ControlLaw]) -> str:
    if law.velocity_form:
        return "adds a move to the applied MV: bumpless by itself"
    return "computes the MV anew: the loop's transfer limits the first moves"


def _dead_time(law: type[ControlLaw]) -> str:
    if law.looks_ahead is not None:
        return f"the plant must answer within {law.looks_ahead} sample(s), in the right direction"
    if law.observes_within is not None:
        return f"some measured variable must answer within {law.observes_within} sample(s)"
    return "any"


def _path(law: type[ControlLaw]) -> str:
    return law.__module__.partition(".")[2].replace(".", "/") + ".py"  # the folders lie at the root


def choice() -> str:
    """A line for each law: title, the model that it needs, the cases that ship it."""
    rows = [
        (
            f"[{law.title}]({name}.md)",
            code(name),
            ", ".join(code(p) for p in law.parts) or "none",
            "one" if law.one_loop else "several",
            ", ".join(code(case) for case, _, _ in shipped().get(name, [])),
        )
        for name, law in LAWS.items()
    ]
    return table(["law", "name", "model parts", "loops", "shipped in"], rows)


def info_names() -> str:
    """Every info name, its unit, its meaning, and the laws that have it."""
    rows = [
        (
            code(name),
            entry["unit"],
            prose(entry["words"]),
            ", ".join(f"[{law}](../theory/{law}.md)" for law in LAWS if name in info_of(law)),
        )
        for name, entry in told().items()
    ]
    return table(["info", "unit", "meaning", "laws"], rows)


def results(name: str) -> str:
    """The law at the gate of each case that ships it, from the cases' validation.json."""
    rows = []
    for case, controller, _ in shipped().get(name, []):
        found = Validation.read(ROOT / "artifacts" / case / FILE)
        gate, step = found.gate, found.laws[controller].step_us
        own, base = gate.laws[controller], gate.laws[gate.baseline]
        rows.append(
            (
                f"[{found.titles.case}](../../pipeline/cases/{_folder(case)}/README.md)",
                _score(own.score),
                f"{_score(base.score)} ({gate.baseline_name})",
                "not counted" if own.lock_ups is None else str(own.lock_ups),
                "" if step is None else f"{step:.0f}",
            )
        )
    if not rows:
        return "No case ships it yet."
    head = ["case", "gate score", "baseline's score", "lock-ups", "step, median [us]"]
    return "\n\n".join(
        [
            table(head, rows),
            "The score is the law's error over that of the NMPC that knows the plant, a weighted mean over the "
            "tests: 1 is as good, less is better. [How the evidence is made](../evidence.md) says the rest.",
        ]
    )


def _folder(case: str) -> str:
    """The folder of a case's README; a case at another sampling period shares that of its plant."""
    return next(
        p.parent.name for p in (ROOT / "pipeline" / "cases").glob("*/README.md") if case.startswith(p.parent.name)
    )


def _score(score: float | None) -> str:
    return "not measured" if score is None else f"{score:.2f}"
