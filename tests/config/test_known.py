"""What an engineer knows of a pair: how it is written, what cannot be, and what a gain says to it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import yaml

from loopwright.pipeline.config.known import Known, stated, together
from loopwright.pipeline.config.plants import PlantParams
from loopwright.pipeline.errors import ParamsError

INF = float("inf")


@pytest.mark.parametrize(
    ("text", "sign", "gain", "dead_s", "way"),
    [
        ("+", "+", None, None, 1),
        ("-", "-", None, None, -1),
        ("−", "-", None, None, -1),  # a spreadsheet's sign of minus
        ("None", "none", None, None, 0),
        ("gain 0.5..2", "", (0.5, 2.0), None, 1),
        ("gain -2..-.5", "", (-2.0, -0.5), None, -1),
        ("gain -1..1", "", (-1.0, 1.0), None, 0),
        ("gain .5...75", "", (0.5, 0.75), None, 1),
        ("dead 30..60", "", None, (30.0, 60.0), 0),
        (" + , gain 0,5..2 ,dead 0..1e2", "+", (0.5, 2.0), (0.0, 100.0), 1),  # a decimal comma
    ],
)
def test_a_statement_is_read_and_written_in_one_form(text: str, sign: str, gain: Any, dead_s: Any, way: int) -> None:
    one = stated("T", "u", text)
    assert (one.sign, one.gain, one.dead_s, one.way) == (sign, gain, dead_s, way)
    assert stated("T", "u", one.says) == one


@pytest.mark.parametrize(
    "text",
    ["", "up", "gain", "gain 1", "gain 1..", "gain a..b", "gain 2..1", "gain 1..inf", "dead -5..5", "dead 9..3", "+, -",
     "gain 1..2, gain 1..3", "none, gain 1..2", "none, dead 1..2", "+, gain -2..-1", "-, gain 0..1"],
)  # fmt: skip
def test_what_cannot_be_is_refused(text: str) -> None:
    with pytest.raises(ValueError):  # noqa: PT011 -- kinds, not sentences
        stated("T", "u", text)


def test_statements_on_a_pair_add_up_and_must_not_contradict_each_other() -> None:
    of = [stated("T", "u", "+"), stated("T", "d", "none"), stated("T", "u", "dead 1..2"), stated("T", "u", "+")]
    assert together(of) == (Known("T", "u", "+", None, (1.0, 2.0)), Known("T", "d", "none"))
    for other in ("-", "none", "gain -2..-1"):
        with pytest.raises(ValueError, match="T/u"):
            together([stated("T", "u", "+"), stated("T", "u", other)])


@pytest.mark.parametrize(
    ("text", "gain", "sd", "least", "excluded"),
    [
        ("+", -1.0, 0.3, 0.0, True),
        ("+", -1.0, 0.4, 0.0, False),  # not certain by three standard deviations
        ("-", 1.0, 0.3, 0.0, True),
        ("gain 1..2", 2.5, 0.1, 0.0, True),
        ("gain 1..2", 2.5, 0.2, 0.0, False),
        ("gain 1..2", 0.5, 0.1, 0.0, True),
        ("none", 0.5, 0.1, 0.1, True),
        ("none", 0.5, 0.1, 0.3, False),
        ("dead 1..2", 1e9, 0.0, 0.0, False),
    ],
)
def test_a_gain_is_excluded_where_it_is_certain(
    text: str, gain: float, sd: float, least: float, excluded: bool
) -> None:
    assert stated("T", "u", text).excludes(gain, sd, least) is excluded


def plant(known: list[dict[str, Any]] | None) -> PlantParams:
    """``plants.it`` of params.yaml in the present folder: T and P, moved by u and w, and disturbed by d."""
    names = {"pv": ("T", "P"), "mv": ("u", "w"), "dv": ("d",)}
    groups = {role: [{"name": n, "unit": "m", "low": 0.0, "high": 1.0} for n in of] for role, of in names.items()}
    entry = {"period_s": 1.0, **groups, "data": "x.parquet", **({} if known is None else {"known": known})}
    Path("params.yaml").write_text(yaml.safe_dump({"plants": {"it": entry}}, allow_unicode=True))
    return PlantParams.read("it")


def test_params_yaml_gives_back_what_is_known(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    of = [stated("T", "u", "-, gain -2..-.5, dead 0..7.5"), stated("P", "d", "none"), stated("P", "w", "+")]
    assert plant([one.to_dict() for one in of]).known == tuple(of)
    assert plant(None).known == ()  # a plant of before


@pytest.mark.parametrize(
    "known",
    [
        [{"pv": "T", "input": "v", "sign": "+"}],
        [{"pv": "u", "input": "u", "sign": "+"}],
        [{"pv": "T", "input": "u"}],
        [{"pv": "T", "input": "u", "sign": "up"}],
        [{"pv": "T", "input": "u", "gain": [2, 1]}],
        [{"pv": "T", "input": "u", "gain": [1]}],
        [{"pv": "T", "input": "u", "sign": "+"}, {"pv": "T", "input": "u", "sign": "-"}],
        [{"pv": "T", "input": "u", "sign": "none"}, {"pv": "T", "input": "w", "sign": "none"}],  # nothing holds T
        [{"pv": "T", "input": "u", "sign": "none"}, {"pv": "P", "input": "u", "sign": "none"}],  # u holds nothing
    ],
)
def test_params_yaml_is_refused_in_one_line(
    known: list[dict[str, Any]], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(ParamsError) as error:
        plant(known)
    assert "\n" not in str(error.value)
    assert "plants.it" in str(error.value)
