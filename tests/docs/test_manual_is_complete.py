"""What the code has, the manual has: each law, model, excitation, metric, parameter, command, option, key and error."""

from __future__ import annotations

import ast
import dataclasses
import re
import runpy
from collections.abc import Iterator

import pytest
from manual.commands import arguments, parsers, spelled
from manual.contents import GENERATED, OF_CASES, SECTIONS
from manual.errors import known
from manual.floors import imports, layers
from manual.laws import info_of, shipped, told
from manual.parameters import fields, is_described, parameters, parts_of, words
from pages import DOCS, ROOT

from loopwright import serving
from loopwright.pipeline.cases import CASES
from loopwright.pipeline.evaluation.metric import METRICS
from loopwright.pipeline.evaluation.validation import Validation
from loopwright.pipeline.excitation import EXCITATIONS
from loopwright.pipeline.laws import LAWS
from loopwright.pipeline.models import MODELS
from loopwright.pipeline.models.training.fit import TRAINERS
from loopwright.serving.manifest import Manifest
from loopwright.serving.station.settings import Settings

ROOTS: dict[str, type] = {
    **{f"law {name}": law.Params for name, law in LAWS.items()},
    **{f"model {kind}": part for kind, part in MODELS.items()},
    **{f"trainer {name}": trainer for name, trainer in TRAINERS.items()},
    **{f"excitation {kind}": excitation for kind, excitation in EXCITATIONS.items()},
    **{f"kind of a case {kind}": cls for members in OF_CASES.values() for kind, cls in members.items()},
    **{f"section {name}": section for name, section in SECTIONS.items()},
    "manifest": Manifest,
    "validation.json": Validation,
    "loop.toml": Settings,
}
UNITS = {"_s": "s", "_ms": "ms", "_us": "us", "_h": "h", "_mb": "MB", "_per_min": "unit/min"}
LEAST = 40  # characters of a section: a short sentence
PARTS = ("Problem", "The law", "When to use it", "When not", "In closed loop", "References")


def every_dataclass() -> Iterator[type]:
    """The classes of ``ROOTS`` and those within their fields, each once."""
    seen = set()
    for root in ROOTS.values():
        for cls in (root, *(part for _, part in parts_of(root))):
            if cls not in seen:
                seen.add(cls)
                yield cls


def content(text: str, part: str) -> str:
    """What stands under a heading, to the next one of its level, without space; empty where there is none."""
    found = re.search(rf"^## {re.escape(part)}\n(.*?)(?=^## |\Z)", text, re.MULTILINE | re.DOTALL)
    return re.sub(r"\s|<!--.*?-->", "", found[1], flags=re.DOTALL) if found else ""


def asked() -> set[str]:
    """All that the pages ask to be generated."""
    return {
        text
        for page in DOCS.rglob("*.md")
        for text in re.findall(
            r"^(?:```\{generated\}|<!-- generated:) (.+?)(?: -->)?$", page.read_text("utf-8"), re.MULTILINE
        )
    }


@pytest.mark.parametrize("law", LAWS)
def test_a_law_has_its_theory_page(law: str) -> None:
    page = DOCS / "theory" / f"{law}.md"
    assert page.is_file(), f"write docs/theory/{law}.md, as the pages beside it"
    text = page.read_text(encoding="utf-8")
    missing = [part for part in PARTS if len(content(text, part)) < LEAST]
    assert not missing, f"{page.name} says next to nothing under {missing}"
    assert "\n$$\n" in text, "give the law's formula"
    assert "```{diagram}" in text, "draw the law"
    assert f"<!-- generated: law {law} -->\n" in text
    assert f"```{{generated}} results {law}\n" in text
    assert re.search(rf"figures/closed_loop_{law}\.png\)", text)
    assert f"\n{law}\n" in (DOCS / "theory" / "index.md").read_text(encoding="utf-8")


@pytest.mark.parametrize("law", LAWS)
def test_a_theory_page_names_parameters_as_they_are(law: str) -> None:
    """`name: value` on a page is a setting of the law."""
    text = (DOCS / "theory" / f"{law}.md").read_text(encoding="utf-8")
    classes = (LAWS[law].Params, *(part for _, part in parts_of(LAWS[law].Params)))
    names = {f.name for cls in classes for f in fields(cls)}
    assert {name for name, _ in re.findall(r"`(\w+): ([\w.]+)`", text)} <= names


def test_no_theory_page_is_of_a_law_that_is_gone() -> None:
    assert {page.stem for page in (DOCS / "theory").glob("*.md")} == {*LAWS, "index"}


def test_what_is_generated_is_as_the_code_has_it() -> None:
    """``python tools/reference_pages.py`` writes it."""
    tool = runpy.run_path(str(DOCS.parent / "tools" / "reference_pages.py"))
    assert [page.name for page in tool["pages"]()] == []


def test_everything_that_is_generated_stands_on_a_page() -> None:
    names = {name.split()[0] for name in asked()}
    assert names == set(GENERATED)


@pytest.mark.parametrize("cls", list(every_dataclass()), ids=lambda cls: cls.__qualname__)
def test_each_parameter_is_described(cls: type) -> None:
    missing = [f.name for f in fields(cls) if not is_described(cls, f.name)]
    assert not missing, (
        f"{cls.__module__}.{cls.__qualname__}: {missing}; name each in the docstring as ``name``, or in words.toml"
    )


@pytest.mark.parametrize("cls", list(every_dataclass()), ids=lambda cls: cls.__qualname__)
def test_a_parameter_whose_name_has_a_unit_shows_it(cls: type) -> None:
    shown = dict(re.findall(r"^\| `(\w+)` \| (?:[^|\\]|\\.)+ \| ([^|]*?) *\|", parameters(cls), re.MULTILINE))
    for name in (f.name for f in fields(cls)):
        for end, unit in UNITS.items():
            assert not name.endswith(end) or shown[name] == unit, f"{cls.__qualname__}.{name}: {shown[name]!r}"


def test_no_words_are_of_a_parameter_that_is_gone() -> None:
    known_fields = {
        base.__qualname__: {f.name for f in dataclasses.fields(base)}
        for cls in every_dataclass()
        for base in cls.__mro__
        if dataclasses.is_dataclass(base)
    }
    gone = {
        f"{cls}.{name}" for cls, given in words().items() for name in given if name not in known_fields.get(cls, set())
    }
    assert not gone


@pytest.mark.parametrize(
    ("generated", "names"),
    [
        ("models", [*MODELS, *TRAINERS, *OF_CASES["models"]]),
        ("excitations", [*EXCITATIONS, *OF_CASES["excitations"]]),
        ("metrics", [*METRICS, *(m.name for case in CASES.values() for m in case.own_metrics)]),
        ("errors", [cls.__name__ for cls in known()]),
        ("params", list(SECTIONS)),
        ("floors", [name for floor in layers() for name in floor]),
        ("laws", list(LAWS)),
    ],
)
def test_the_generated_pages_name_every_member(generated: str, names: list[str]) -> None:
    text = GENERATED[generated]()
    assert [name for name in names if f"`{name}`" not in text] == []


def test_every_key_of_loop_toml_is_named() -> None:
    text = GENERATED["loop.toml"]()
    keys = {f.name for cls in (Settings, *(part for _, part in parts_of(Settings))) for f in fields(cls)}
    assert len(keys) > 40
    assert [key for key in keys if f"`{key}`" not in text] == []


def test_each_command_and_option_has_its_words() -> None:
    text = GENERATED["commands"]()
    silent = [f"{p.prog} {spelled(a)}" for p, about in parsers() for a in arguments(p) if not a.help or not about]
    assert not silent
    absent = [
        f"{p.prog} {option}"
        for p, _ in parsers()
        for a in arguments(p)
        for option in a.option_strings
        if option not in text
    ]
    assert not absent
    assert all(f"`{p.prog}`" in text for p, _ in parsers())


def test_each_info_name_is_described() -> None:
    given = {name for law in LAWS for name in info_of(law)}
    unknown = given - set(told())
    assert not unknown, f"add {sorted(unknown)} to docs/_ext/manual/info.toml"
    assert set(LAWS) == set(shipped()), "each law is shipped in some case, so that its info is known"
    # A law of several loops names its MVs; no shipped controller has several.
    assert set(told()) - given == {"NAME_requested"}


def test_no_error_class_is_missing() -> None:
    names = {"LoopwrightError"}
    classes = [
        (node.name, {base.id for base in node.bases if isinstance(base, ast.Name)})
        for package in ("serving", "pipeline")
        for path in (ROOT / package).rglob("*.py")
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8")))
        if isinstance(node, ast.ClassDef)
    ]
    while more := {name for name, bases in classes if bases & names} - names:
        names |= more
    assert names == {cls.__name__ for cls in known()}


def test_the_python_api_names_all_that_a_host_may_import() -> None:
    text = (DOCS / "reference" / "api.md").read_text(encoding="utf-8")
    documented = re.findall(r"^\.\. auto\w+:: loopwright\.serving\.(\w+)$", text, re.MULTILINE)
    assert sorted(documented) == sorted(serving.__all__)


def test_the_floors_are_those_of_the_code() -> None:
    order = {name: i for i, floor in enumerate(layers()) for name in floor}
    folders = {p.stem for p in (ROOT / "pipeline").iterdir() if p.suffix == ".py" or (p / "__init__.py").exists()}
    assert set(order) == folders - {"__init__"}
    assert imports()["laws"] >= {"models", "plants"}
    upward = [(a, b) for a, targets in imports().items() for b in targets if b != "serving" and order[b] <= order[a]]
    assert not upward


def test_the_pages_that_are_written_by_hand_name_each_law_and_mode() -> None:
    """Beside the generated lists: who chooses a law reads the index, who runs a loop reads On the plant."""
    plant = (DOCS / "on_the_plant.md").read_text(encoding="utf-8")
    assert all(f"| {mode} |" in plant for mode in serving.Mode)
    cases = (DOCS / "cases.md").read_text(encoding="utf-8")
    assert [name for name in CASES if f"`{name}`" not in cases] == []
