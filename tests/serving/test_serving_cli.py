"""``python -m loopwright.serving``: a card that a person can read, JSON for programs, one line for an error."""

from __future__ import annotations

import argparse
import json
import tomllib
from dataclasses import replace
from pathlib import Path

import pytest

from loopwright.pipeline.export.controller_file import with_evidence
from loopwright.serving import ArtifactError, Controller, Manifest
from loopwright.serving.__main__ import main
from loopwright.serving.operating import unit_words
from loopwright.serving.station import command
from loopwright.serving.station.settings import template
from loopwright.serving.words import harmless, plain

pytest_plugins = ["small_laws", "operated_laws"]
Capture = pytest.CaptureFixture[str]


def test_card(pi_file: Path, capsys: Capture) -> None:
    assert main(["inspect", str(pi_file)]) == 0
    card = capsys.readouterr().out
    for line in (
        "formula for tank",
        "  period    0.5 s",
        "  level  0 .. 2 m",
        "  valve  0 .. 100 %",
        "inputs      sp, pv, mv_applied, state",
        "outputs     mv, state_next, info",
        "info        error, move",
        "  git: 0123abc",
        "               mae         ise",
        "  step        0.25         0.5",
    ):
        assert line in card.splitlines()
    assert Controller(pi_file).sha256 in card


def test_the_card_says_what_operators_may_change(operated_file: Path, pi_file: Path, capsys: Capture) -> None:
    assert main(["inspect", str(operated_file)]) == 0
    rows = [line.split() for line in capsys.readouterr().out.splitlines()]
    for e in Controller(operated_file).manifest.operate:
        switch = e.what in {"use", "track", "rest_use"}
        allowed = ["0", "or", "1"] if switch else [f"{e.low:g}", "..", f"{e.high:g}"]
        unit = unit_words(e, Controller(operated_file).manifest.period_s)
        assert [e.name, f"{e.default:g}", *allowed, *unit.split()] in rows
    assert main(["inspect", str(operated_file), "--json"]) == 0
    assert len(json.loads(capsys.readouterr().out)["operate"]) == len(Controller(operated_file).manifest.operate)
    assert main(["inspect", str(pi_file)]) == 0
    assert "operate" not in capsys.readouterr().out


@pytest.mark.parametrize(
    ("evidence", "text"),
    [
        ({}, "  none yet: this controller was not validated"),
        ({"mae": 0.25, "seeds": [1, 2]}, "  mae: 0.25\n  seeds: 1, 2"),
        (
            {"scenarios": {"sp_a": {"mae": 1 / 3}, "ua": {"ise": 2}}, "seeds": 5},
            "  ua             -           2\n  seeds: 5",
        ),
        (
            {"scenarios": {"ua": {"mae": 0.5, "travel": 2}}, "units": {"mae": "mol/l"}},
            "      mae [mol/l]      travel\n  ua          0.5           2\n",
        ),
        ({"gate": {"passed": "yes"}}, "  gate\n    passed: yes"),
    ],
)
def test_any_evidence_can_be_shown(
    pi_file: Path, tmp_path: Path, capsys: Capture, evidence: dict[str, object], text: str
) -> None:
    with_evidence(pi_file, tmp_path / "x.onnx", evidence)
    assert main(["inspect", str(tmp_path / "x.onnx")]) == 0
    assert text in capsys.readouterr().out


def test_lock_ups_are_said_first(pi_file: Path, tmp_path: Path, capsys: Capture) -> None:
    locked = {"sp_a": {"0": 2, "3": 1}, "held_out_noise": {"1": 1}}
    evidence = {"seeds": 5, "lock_ups": 4, "locked_up": locked, "as_printed": True, "scenarios": {"sp_a": {"mae": 0.1}}}
    with_evidence(pi_file, tmp_path / "x.onnx", evidence)
    assert main(["inspect", str(tmp_path / "x.onnx")]) == 0
    assert capsys.readouterr().out.splitlines()[:5] == [
        "formula for tank",
        "  LOCKED UP in 4 closed loops of its validation: do not run it on a plant",
        "    sp_a (seed 0: 2, seed 3: 1)",
        "    held_out_noise (seed 1: 1)",
        "    shipped as printed, to reproduce a paper",
    ]
    for sound in ({"lock_ups": 0}, {"lock_ups": "none"}, {}):
        with_evidence(pi_file, tmp_path / "x.onnx", sound)
        assert main(["inspect", str(tmp_path / "x.onnx")]) == 0
        assert "LOCKED UP" not in capsys.readouterr().out


def test_loops_that_swing_and_data_that_are_doubtful_are_said_first(
    pi_file: Path, tmp_path: Path, capsys: Capture
) -> None:
    evidence = {
        "lock_ups": 0,
        "swings": {"spoilt": {"0": 2}, "load": {"0": 1}},
        "beyond_reach": {"spoilt": {"1": 4}},
        "on": {"words": "on models", "data": "doubtful", "data_reasons": ["few rows"]},
        "scenarios": {"load": {"mae": 0.1}},
    }
    with_evidence(pi_file, tmp_path / "x.onnx", evidence)
    assert main(["inspect", str(tmp_path / "x.onnx")]) == 0
    assert capsys.readouterr().out.splitlines()[:7] == [
        "formula for tank",
        "  SWINGS to the end in 3 closed loops of its validation",
        "    spoilt (seed 0: 2)",
        "    load (seed 0: 1)",
        "  holds at an end of the MVs whose set point no control gets to in time, no lock-ups",
        "    spoilt (seed 1: 4)",
        "  DATA: can they carry a model: doubtful (few rows)",
    ]
    for odd in ({"swings": 3, "beyond_reach": "x", "on": 4}, {"swings": {"load": 3}, "on": {"data": "yes"}}):
        with_evidence(pi_file, tmp_path / "x.onnx", odd)
        assert main(["inspect", str(tmp_path / "x.onnx")]) == 0
        assert "DATA" not in capsys.readouterr().out


def test_json(pi_file: Path, capsys: Capture) -> None:
    assert main(["inspect", "--json", str(pi_file)]) == 0
    row = json.loads(capsys.readouterr().out)
    assert row["law"] == "formula"
    assert row["file"]["bytes"] == pi_file.stat().st_size
    assert row["graph"]["opset"] <= 21


def test_bench(pi_file: Path, capsys: Capture) -> None:
    assert main(["bench", str(pi_file), "--steps", "50", "--loop-steps", "10"]) == 0
    head, *rows = capsys.readouterr().out.splitlines()
    *rows, note = rows
    assert head.split() == ["step", "[us]", "p50", "p99", "p99.9", "waited", "p99.9", "of", "the", "others"]
    assert [row[:22].strip() for row in rows] == ["hot", "every 10 ms, warmed", "every 10 ms, cold"]
    for row in rows:
        p50, p99, p999, waited, _, alone, _, times, _ = row[22:].split()
        assert 0 < float(p50) <= float(p99) <= float(p999)
        assert 0 <= float(waited) <= 100
        assert not float(alone) <= 0  # nan where every step waited
        # Each of the three is rounded as it is printed.
        half = [0.51 * 10.0 ** -len(number.partition(".")[2]) for number in (alone, p50, times)]
        least, most = (
            (float(alone) - half[0]) / (float(p50) + half[1]),
            (float(alone) + half[0]) / (float(p50) - half[1]),
        )
        assert not float(times) < least - half[2]
        assert not float(times) > most + half[2]
    assert "other programs" in note


def test_errors_are_one_line(pi_file: Path, tmp_path: Path, capsys: Capture) -> None:
    for arguments in (
        ["inspect", "none.onnx"],
        ["bench", str(tmp_path)],
        ["inspect", str(pi_file.with_suffix(".json"))],
        ["inspect", str(pi_file), "--sha256", "0" * 64],
    ):
        assert main(arguments) == 2
        error = capsys.readouterr().err
        assert error.startswith("error: ")
        assert error.count("\n") == 1


def test_without_a_command_it_says_what_it_can(capsys: Capture) -> None:
    assert main([]) == 0
    assert "inspect" in capsys.readouterr().out


FORGED = 'x"\nstart = "AUTO"\n[hold]\x1b[2J\x85\u202e\u2067\u2028\r'
"""A text that would write settings, clear a screen and turn a line round."""


def test_a_text_of_a_file_acts_on_nobody_who_reads_it(pi_file: Path, tmp_path: Path, capsys: Capture) -> None:
    """Provenance and evidence hold any text, as keys and as values."""
    forged = tmp_path / "forged.onnx"
    with_evidence(pi_file, forged, {FORGED: {FORGED: 1.0}, "scenarios": {FORGED: {FORGED: 1.0}}, "units": [FORGED]})
    assert main(["inspect", str(forged)]) == 0
    said = capsys.readouterr().out
    assert all(line.isprintable() for line in said.split("\n"))
    assert plain(FORGED) in said
    assert main(["inspect", str(tmp_path / f"{FORGED}.onnx".replace("/", ""))]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.isprintable()


def test_what_a_loop_answers_acts_on_nobody(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: Capture) -> None:
    """Whoever may write the folder of its door can answer in its place."""
    settings = tmp_path / "loop.toml"
    settings.write_text(
        'controller = "a.onnx"\n[server]\nendpoint = "opc.tcp://a:1"\nsecurity = "None"\ninsecure = true\n'
        '[nodes.pv]\ny = "ns=1;s=y"\n[nodes.mv]\nu = "ns=1;s=u"\n'
    )
    monkeypatch.setattr(command, "ask", lambda *_: {"done": FORGED})
    parser = argparse.ArgumentParser()
    command.options(parser)
    assert command.run(parser.parse_args(["mode", "AUTO", "--loop", str(settings)])) == 0
    assert capsys.readouterr().out == f"{plain(FORGED)}\n"


def test_a_text_of_many_lines_keeps_its_lines_alone() -> None:
    assert harmless("a\n\tb\x1b\u200f\ufeff\r温度\u200c\u00a0") == "a\n\tb\\x1b\\u200f\\ufeff\\r温度\u200c\u00a0"


@pytest.mark.parametrize("bad", ["\n", "\x00", "\x1b[2J", "\x85", "\u2028", "\u202e", "\u200e", "\u061c", "\ufeff"])
@pytest.mark.parametrize("place", ["law", "case", "name", "unit", "info"])
def test_a_name_that_could_forge_a_line_is_refused(pi_file: Path, bad: str, place: str) -> None:
    row = json.loads(Controller(pi_file).manifest.to_json())
    (row["pv"][1] if place in {"name", "unit"} else row)[place] = ["a", bad] if place == "info" else f"T{bad}"
    with pytest.raises(ArtifactError, match="line break, control or direction"):
        Manifest.from_json(json.dumps(row))


@pytest.mark.parametrize(
    "name", ["m³/h", "Ölstand", "TIC-101.PV", "温度", "حرارة", "می\u200cرود", "a\u00a0b", "%", "°C"]
)
def test_a_name_of_any_script_is_none_of_them(pi_file: Path, name: str) -> None:
    row = json.loads(Controller(pi_file).manifest.to_json())
    row["pv"][1].update(name=name, unit=name)
    assert Manifest.from_json(json.dumps(row)).pv[1].name == name


def test_no_text_writes_settings_into_a_loop_toml(pi_file: Path) -> None:
    """Also where a controller was made in Python, whose manifest nobody has read."""
    made = Controller(pi_file)
    m = made.manifest
    pv = tuple(replace(s, name=s.name + FORGED, unit=FORGED) for s in m.pv)
    mv = tuple(replace(s, name=s.name + FORGED, unit=FORGED) for s in m.mv)
    made.manifest = replace(m, law=FORGED, case=FORGED, pv=pv, mv=mv)
    found = tomllib.loads(template(made, Path(f"{FORGED}.onnx"), f"opc.tcp://{FORGED}", f"{FORGED}.journal"))
    assert (found["start"], found["controller"], found["journal"]["file"]) == (
        "SHADOW", f"{FORGED}.onnx", f"{FORGED}.journal",
    )  # fmt: skip
    assert found["hold"]["then"] == "stay"
    assert list(found["nodes"]["pv"]) == [s.name for s in pv]
    assert found["nodes"]["mv"][mv[0].name]["node"].endswith(mv[0].name)
