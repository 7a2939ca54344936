"""params.yaml: what is read, and what every mistake in it says."""

import re
import runpy
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import pytest
import yaml
from shipped import required

from loopwright.pipeline import errors
from loopwright.pipeline.cases import CASES
from loopwright.pipeline.config.params import (
    ControllerParams,
    ModelParams,
    RecordParams,
    choose,
    parse,
    read_section,
    sections,
)
from loopwright.pipeline.errors import ParamsError, PipelineError
from loopwright.pipeline.evaluation.evidence import NotMeasuredError
from loopwright.pipeline.files import digest
from loopwright.pipeline.laws import LAWS
from loopwright.pipeline.models import MODELS
from loopwright.pipeline.stages.excite import excitations
from loopwright.pipeline.stages.fit import parts_of


@dataclass(frozen=True)
class Inner:
    gain: float = 1.0


@dataclass(frozen=True)
class Example:
    count: int
    name: str = "a"
    rate: float | None = None
    kind: Literal["x", "y"] = "x"
    seeds: tuple[int, ...] = ()
    pair: tuple[float, float] = (0.0, 1.0)
    inner: Inner = Inner()
    free: Mapping[str, Any] | None = None

    def __post_init__(self) -> None:
        if self.count < 1:
            raise ValueError(f"count is {self.count}; it must be at least 1")


def test_parse_converts_and_nests() -> None:
    found = parse(Example, {"count": 3, "rate": 2, "seeds": [1, 2], "pair": [0, 5], "inner": {"gain": "5e-4"}}, "here")
    assert found == Example(3, rate=2.0, seeds=(1, 2), pair=(0.0, 5.0), inner=Inner(5e-4))


@pytest.mark.parametrize(
    ("values", "says"),
    [
        ({"count": 1, "nmae": "b"}, "here: unknown key 'nmae'; did you mean 'name'?"),
        ({}, "here: 'count' is missing"),
        ({"count": "many"}, "here.count is 'many'; it must be of type int"),
        ({"count": True}, "here.count is True; it must be of type int"),
        ({"count": 0}, "here: count is 0; it must be at least 1"),
        ({"count": 1, "kind": "z"}, "here.kind is 'z'"),
        ({"count": 1, "seeds": 4}, "here.seeds is 4; it must be a list"),
        ({"count": 1, "seeds": [1, "b"]}, "here.seeds[1] is 'b'"),
        ({"count": 1, "pair": [1]}, "here.pair has 1 entries; it must have 2"),
        ({"count": 1, "inner": {"gian": 2}}, "here.inner: unknown key 'gian'; did you mean 'gain'?"),
        ({"count": 1, "rate": "fast"}, "here.rate is 'fast'; it must be a number"),
    ],
)
def test_parse_says_what_is_wrong_and_where(values: dict[str, Any], says: str) -> None:
    with pytest.raises(ParamsError) as error:
        parse(Example, values, "here")
    assert says in str(error.value)
    assert "\n" not in str(error.value)


def test_section_errors_name_the_nearest(tmp_path: Path) -> None:
    path = tmp_path / "params.yaml"
    with pytest.raises(ParamsError, match="run from the repository's root"):
        read_section("records", "a", path)
    path.write_text("records: {first: {kind: prbs}, second: 3}\n")
    assert read_section("records", "first", path) == {"kind": "prbs"}
    with pytest.raises(ParamsError, match="did you mean 'first'"):
        read_section("records", "frist", path)
    with pytest.raises(ParamsError, match="must be a mapping"):
        read_section("records", "second", path)
    path.write_text("records: [")
    with pytest.raises(ParamsError, match="is not YAML"):
        read_section("records", "first", path)


def test_every_error_stands_in_the_tree() -> None:
    known = [error.__name__ for error in (PipelineError, *PipelineError.__subclasses__())]
    assert NotMeasuredError.__name__ in known
    assert [name for name in known if name not in (errors.__doc__ or "").split()] == []


def test_a_record_needs_seeds() -> None:
    values = {"case": "c", "record": "r", "seeds": [], "kind": "prbs", "excitation": {}}
    with pytest.raises(ParamsError, match=r"records\.x: seeds is \[\]; give one or more"):
        parse(RecordParams, values, "records.x")


def test_choose_names_the_nearest() -> None:
    with pytest.raises(ParamsError, match="unknown law 'incda'; did you mean 'incad'"):
        choose(LAWS, "incda", "law", "controllers.x")


def test_digest_does_not_depend_on_order() -> None:
    assert digest({"a": 1, "b": [2]}) == digest({"b": [2], "a": 1}) != digest({"a": 1, "b": [3]})


def test_the_shipped_file_is_read_whole(monkeypatch: pytest.MonkeyPatch) -> None:
    """Every section of params.yaml parses against the dataclass that its stage uses, and refers to what exists."""
    root = Path(__file__).parents[2]
    monkeypatch.chdir(root)
    tree = yaml.safe_load((root / "params.yaml").read_text())
    models = set()
    for name in tree["records"]:
        record = RecordParams.read(name)
        parse(excitations(CASES[record.case])[record.kind], record.excitation, name)
        assert name == f"{record.case}-{record.record}"
    for name in tree["models"]:
        model = ModelParams.read(name)
        assert set(parts_of(model, name)) == set(model.parts)
        models.add((model.case, model.model))
        assert name == f"{model.case}-{model.model}"
    for name in tree["controllers"]:
        controller = ControllerParams.read(name)
        for settings in ({}, *controller.variants.values()):
            parse(LAWS[controller.law].Params, {**controller.settings, **settings}, name)
        assert (controller.case, controller.model) in models
        assert name == f"{controller.case}-{controller.name}"
    assert set(tree["cases"]) == set(CASES)


def test_reduced_numbers_all_stand_in_the_shipped_file() -> None:
    """A key that tools/reduced.py shrinks but no section has would leave the reduced run at full size."""
    root = Path(__file__).parents[2]
    text = (root / "params.yaml").read_text()
    assert [key for key in runpy.run_path(str(root / "tools" / "reduced.py"))["SMALL"] if f"{key}:" not in text] == []


def test_the_reduced_run_shows_every_case_and_law_and_lacks_nothing_that_it_needs() -> None:
    root = Path(__file__).parents[2]
    whole = yaml.safe_load((root / "params.yaml").read_text())
    tree = runpy.run_path(str(root / "tools" / "reduced.py"))["reduced"](whole)
    controllers = tree["controllers"].values()
    assert {c["law"] for c in controllers} == {c["law"] for c in whole["controllers"].values()}
    assert {c["case"] for c in controllers} == set(CASES)
    assert len(controllers) < len(whole["controllers"])
    models = {(m["case"], m["model"]) for m in tree["models"].values()}
    assert {(c["case"], c["model"]) for c in controllers} <= models
    records = {f"work/{r['case']}/records/{r['record']}" for r in tree["records"].values()}
    data = {m["data"] for m in tree["models"].values()}
    assert {d for d in data if d.startswith("work/")} == records
    # Nothing grew: a batch is shorter than what a record is cut down to.
    assert tree["records"]["batch_reactor-batches"]["samples"] == whole["records"]["batch_reactor-batches"]["samples"]


@pytest.mark.parametrize(
    ("cls", "values", "said"),
    [
        (LAWS["linearized_pid"].Params, {"slope_min": -1.0}, "slope_min is -1.0"),
        (LAWS["self_tuning_pid"].Params, {**required("self_tuning_pid"), "slope_min": -1.0}, "slope_min is -1.0"),
        (MODELS["nnarx"], {"slack": -1.0}, "slack is -1.0; it must be at least 0"),
        (MODELS["nnarx"], {"steps": 0}, "steps is 0; it must be at least 1"),
    ],
)
def test_numbers_that_make_no_sense_are_refused_where_they_stand(cls, values, said):
    with pytest.raises(ParamsError, match=f"here: {re.escape(said)}"):
        parse(cls, values, "here")


LAUGHS = "x-a: &a [1, 1, 1, 1, 1, 1, 1, 1, 1, 1]\n" + "".join(
    f"x-{b}: &{b} [{', '.join([f'*{a}'] * 10)}]\n" for a, b in zip("abcdefgh", "bcdefghi", strict=True)
)


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("cases: {a: {noise_seed: " + "9" * 5001 + "}}", "an integer has 5001 digits"),
        ("cases: {a: {noise_seed: 0x" + "f" * 9000 + "}}", "an integer has 9002 digits"),
        ("cases: {}\ncontroler: {}", "unknown section 'controler'; did you mean 'controllers'?"),
        ("cases: {}\n1: {}", "unknown section 1"),
        ("cases: {}\nyes: {}", "unknown section True"),
        ("cases: {yes: {}}", "cases has the name True, which YAML reads as no text; put it in quotes"),
        ("cases: {}\ncases: {}", "the key 'cases' stands twice in one mapping"),
        ("cases:\n  a: {b: {c: 1, c: 2}}", "the key 'c' stands twice in one mapping"),
        (LAUGHS, "more than 1000000 values"),
        ("x-a: &a [*a]", "an alias inside of what it stands for"),
        ("cases: " + "[" * 60 + "]" * 60, "nested more than 50 deep"),
        ("cases: " + "[" * 30_000 + "]" * 30_000, "nested more than 50 deep"),
        ("cases: {a: 2024-13-45}", "holds a value that cannot be read"),
        ("cases:\n\ta: {}", "is not YAML in UTF-8"),
        ("- cases", "holds no mapping"),
        ("cases", "holds no mapping"),
        ("", "has no 'cases'"),
        ("cases: !!python/object/apply:os.system [ls]", "holds a value that cannot be read"),
        ('cases: !!bool "abc"', "holds a value that cannot be read"),
        ('cases: !!timestamp "x"', "holds a value that cannot be read"),
        ('cases: !!int ""', "holds a value that cannot be read"),
        ("cases: 1" + ":59" * 5000 + ".5", "holds a value that cannot be read"),
    ],
)
def test_whatever_spoils_the_file_is_one_line(text: str, says: str, tmp_path: Path) -> None:
    path = tmp_path / "params.yaml"
    path.write_text(text)
    with pytest.raises(ParamsError) as found:
        sections("cases", path)
    assert says in str(found.value)
    assert len(str(found.value).splitlines()) == 1
    assert len(str(found.value)) < 600


@pytest.mark.parametrize("codec", ["utf-8-sig", "utf-16", "latin-1"])
def test_another_encoding_is_named_and_a_mark_of_utf_8_is_none(codec: str, tmp_path: Path) -> None:
    path = tmp_path / "params.yaml"
    path.write_bytes("cases: {a: {unit: °C}}".encode(codec))
    if codec == "utf-8-sig":
        assert sections("cases", path) == ("a",)
        return
    with pytest.raises(ParamsError, match="is not YAML in UTF-8"):
        sections("cases", path)


def test_values_of_ones_own_that_aliases_repeat_are_no_mistake(tmp_path: Path) -> None:
    path = tmp_path / "params.yaml"
    path.write_text("x-common: &c {noise_seed: 3}\ncases:\n  a: {<<: *c, held_out_seeds: [1]}\n  b: {<<: *c}")
    assert sections("cases", path) == ("a", "b")
    assert read_section("cases", "a", path) == {"noise_seed": 3, "held_out_seeds": [1]}


@pytest.mark.parametrize("value", [float("inf"), float("nan"), "1e999", "-inf", 10**400, "nan"])
def test_a_number_is_finite(value: Any) -> None:
    with pytest.raises(ParamsError, match=r"here\.rate is .*; it must be a (finite )?number$") as found:
        parse(Example, {"count": 1, "rate": value}, "here")
    assert len(str(found.value)) < 200
