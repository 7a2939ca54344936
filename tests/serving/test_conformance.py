"""The conformance kit: what it holds, that it is this runtime's answer, and that its check finds what is wrong."""

from __future__ import annotations

import itertools
import json
import math
from collections import Counter
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from kits import an_old_version

from loopwright.pipeline.export.controller_file import file_bytes
from loopwright.pipeline.export.gate import export
from loopwright.serving import Controller, LoopwrightError, OutputError, SampleError
from loopwright.serving.__main__ import main
from loopwright.serving.conformance.kit import PASS, VECTORS, check, read, write_kit, written
from loopwright.serving.controller_file import TRAILER_BYTES
from loopwright.serving.manifest import SWITCHES
from loopwright.serving.operating import Operate

pytest_plugins = ["small_laws", "operated_laws"]
Capture = pytest.CaptureFixture[str]
Json = dict[str, Any]
Array = np.ndarray[Any, np.dtype[np.float64]]


@pytest.fixture(scope="module")
def kit(pi_file: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("kit")
    write_kit(Controller(pi_file), folder)
    return folder


@pytest.fixture
def vectors(kit: Path) -> Json:
    row: Json = json.loads((kit / VECTORS).read_text())
    return row


@pytest.fixture
def answers(vectors: Json) -> Json:
    """The answers of a host that does all as it must."""
    return perfect(vectors)


def perfect(vectors: Json) -> Json:
    steps = [{"refused": row["refused"]} if "refused" in row else row["gives"] for row in vectors["steps"]]
    scans = [{name: row[name] for name in ("mode", "fault", "mv")} for row in vectors["scans"]]
    whole = {"host": "Perfect", "onnxruntime": "0", "sha256": vectors["sha256"]}
    copy: Json = json.loads(json.dumps(whole | {"steps": steps, "chained": steps, "scans": scans}))
    return copy


def same(state: Array) -> Array:
    return state


def played(
    controller: Controller,
    vectors: Json,
    *,
    takes: Callable[[Array], Array] = same,
    keeps: Callable[[Array], Array] = same,
    rounds: Callable[[Array], Array] = same,
    refused: Callable[[Array], Array] = same,
) -> Json:
    """The answers of a host that does these things to the state: as given, from step to step, and where it refuses.

    ``rounds`` is what its arithmetic does to every number that it computes.
    """
    answers = perfect(vectors)
    for run in ("steps", "chained"):
        rows: list[Json] = []
        state = controller.cold_state()
        for row in vectors["steps"]:
            inputs: Json = dict.fromkeys(("sp", "pv", "mv_applied"))
            inputs |= {name: read(texts, name) for name, texts in row["given"].items()}
            given_state = inputs.pop("state")
            if run == "steps":
                state = takes(given_state)
            elif row["begins"]:
                state = given_state
            try:
                step = controller.step(**inputs, state=state)
            except (SampleError, OutputError) as error:
                rows.append({"refused": "input" if isinstance(error, SampleError) else "output"})
                state = refused(state)
                continue
            mv, after, info = map(rounds, step)
            rows.append({"mv": written(mv), "state_next": written(after), "info": written(info)})
            state = keeps(after)
        answers[run] = rows
    return answers


def chain(vectors: Json) -> list[Json]:
    parts = {"anywhere", "inside", "course", "saturation", "stuck actuator"}
    return [row for row in vectors["steps"] if row["part"] in parts]


def test_each_step_starts_from_its_stated_state(pi_file: Path, vectors: Json) -> None:
    controller, before = Controller(pi_file), None
    cold = written(controller.cold_state())
    for row in vectors["steps"]:
        inputs = {name: read(texts, name) for name, texts in row["given"].items()}
        state = row["given"]["state"]
        assert state == (cold if row["cold"] else before)  # a state that the chain visits
        if "refused" in row:
            with pytest.raises(SampleError):
                controller.step(**inputs)
            continue
        step = controller.step(**inputs)
        found = {"mv": written(step.mv), "state_next": written(step.state), "info": written(step.info)}
        assert found == row["gives"]
        before = row["gives"]["state_next"]
    assert len({tuple(row["given"]["state"]) for row in vectors["steps"]}) > 200


def test_300_steps_are_chained_over_the_whole_ranges(pi_file: Path, vectors: Json) -> None:
    m, rows = Controller(pi_file).manifest, chain(vectors)
    assert len(rows) == 300
    assert [row["cold"] for row in rows] == [True] + [False] * 299
    for name in ("sp", "pv", "mv_applied"):
        values = np.array([read(row["given"][name], name) for row in rows])
        low, high = np.array([(s.low, s.high) for s in m.signals(name)]).T
        assert (values.min(axis=0) == low).all()
        assert (values.max(axis=0) == high).all()
        assert (np.unique(values, axis=0).shape[0]) > 40
    mv = np.array([read(row["gives"]["mv"], "mv")[0] for row in rows])
    assert {0.0, 100.0} <= set(mv)  # saturated at both ends
    assert ((mv > 0) & (mv < 100)).sum() > 100  # and elsewhere a wrong digit shows


@pytest.fixture(scope="module")
def steered(operated_file: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Controller, Path]:
    """The controller that reads ``operate`` and ``fresh``, and its kit."""
    controller, folder = Controller(operated_file), tmp_path_factory.mktemp("steered")
    write_kit(controller, folder)
    return controller, folder


def test_a_kit_holds_what_operators_change(steered: tuple[Controller, Path], vectors: Json) -> None:
    controller, folder = steered
    rows, entries = json.loads((folder / VECTORS).read_text()), controller.manifest.operate
    given = np.array([read(row["given"]["operate"], "operate") for row in rows["steps"]])
    checked = Operate(entries).checked
    assert all(bytes(checked(row)) == bytes(row) for row in given)
    assert bytes(given[0]) == bytes(checked([e.default for e in entries]))
    varied = [len(set(column)) for column in given.T]
    for e, column, n in zip(entries, given.T, varied, strict=True):
        assert n > (1 if e.what in {*SWITCHES, "rank"} else 20)
        assert e.what != "rank" or set(column) == {1.0, 2.0, 3.0, 4.0}
    fresh = np.array([read(row["given"]["fresh"], "fresh") for row in rows["steps"]])
    assert set(map(tuple, fresh)) == {(0, 0), (0, 1), (1, 0), (1, 1)}
    assert rows["kit"] == vectors["kit"]  # the format of the others stays
    assert vectors["pass"] == list(PASS)
    assert rows["pass"][: len(PASS)] == list(PASS)
    assert not {"operate", "fresh"} & set(vectors["steps"][0]["given"])


def test_a_kit_holds_readings_that_stay_bad(steered: tuple[Controller, Path]) -> None:
    """Of one PV: bridged, then left out. Of all: HOLD once none is left."""
    scans = json.loads((steered[1] / VECTORS).read_text())["scans"]
    known = {row["what"]: (row["mode"], row["fault"]) for row in scans}
    for k in range(1, 14):
        assert known[f"PV y0 is bad for {k} scans"] == ("AUTO", False)
        assert known[f"all PVs are bad for {k} scans"] == (("AUTO", False) if k <= 10 else ("HOLD", True))
    assert known["after all PVs were bad"] == ("AUTO", False)
    moves = [row["mv"] for row in scans if row["what"].startswith("PV y0 is bad")]
    assert len(set(map(tuple, moves))) > 5  # the law goes on


@pytest.mark.parametrize("left_out", [None, "operate", "fresh"])
def test_a_host_that_leaves_operators_out_does_not_pass(
    left_out: str | None, steered: tuple[Controller, Path], tmp_path: Path
) -> None:
    controller, folder = steered
    vectors = json.loads((folder / VECTORS).read_text())
    for row in vectors["steps"]:
        row["given"].pop(left_out, None)
    (tmp_path / "answers.json").write_text(json.dumps(played(controller, vectors)))
    verdict = check(folder, tmp_path / "answers.json", controller.sha256)
    assert verdict.identical == (left_out is None)
    assert verdict.passed == (left_out is None)


def test_each_value_that_is_not_finite_is_refused(vectors: Json) -> None:
    spoilt = [
        (name, i, str(value))
        for row in vectors["steps"]
        if "refused" in row
        for name, texts in row["given"].items()
        for i, value in enumerate(read(texts, name))
        if not math.isfinite(value)
    ]
    places = [("sp", 0), ("pv", 0), ("pv", 1), ("mv_applied", 0)]
    assert Counter(spoilt) == Counter((n, i, bad) for n, i in places for bad in ("nan", "inf", "-inf"))


def test_cold_starts_stand_beside_the_chain(vectors: Json) -> None:
    assert sum(row["cold"] for row in vectors["steps"]) == 1 + 10


def test_the_scans_hold_what_the_guards_refuse(vectors: Json) -> None:
    rows = {row["what"]: row for row in vectors["scans"]}
    for what in (
        "PV level nan",
        "PV T above, beyond its margin",
        "applied MV valve below, beyond its margin",
        "applied MV valve not finite",
        "age 1.1 periods",
        "age nan periods",
        "the plant cannot be read",
        "a fault while it recovers",
    ):
        assert rows[what]["fault"], what
        assert rows[what]["mode"] == "HOLD", what
    for what in ("PV T above, within its margin", "applied MV valve below, within its margin", "no read-back"):
        assert not rows[what]["fault"], what
        assert rows[what]["mode"] == "AUTO", what
    assert rows["a fault by hand"] | {"mode": "MANUAL", "fault": True} == rows["a fault by hand"]
    assert [row["missed"] for row in vectors["scans"] if row["missed"]] == [1, 3, 4, 4, 4]


def part(rows: list[Json], words: str) -> int:
    """Where the scans with these words begin."""
    return next(k for k, row in enumerate(rows) if row["what"].startswith(words))


def test_the_scans_hold_what_an_operator_sends(vectors: Json) -> None:
    """In each mode, and around lost commands; a PLC sees a request by its edge, so no two follow each other."""
    rows = vectors["scans"]
    sends = [k for k, row in enumerate(rows) if row["set_mv"] is not None]
    assert all(b - a > 1 for a, b in itertools.pairwise(sends))
    taken = {k for k in sends if rows[k]["mv"] == rows[k]["set_mv"]}
    assert {rows[k]["mode"] for k in taken} == {"MANUAL"}
    assert {rows[k]["mode"] for k in sends} == {"MANUAL", "HOLD", "AUTO"}
    assert len(taken) > 5
    silent = sum(rows[k]["mv"] is None for k in sends)
    assert silent == 4 + 2 + 1  # from nowhere known, after others, and while it is lost
    assert sum(rows[k]["unwritten"] for k in sends) == 1
    changed = [row for row in rows if row["unwritten"] and row["set_mode"]]
    assert [row["set_mode"] for row in changed] == ["MANUAL", "MANUAL", "AUTO"]


def test_the_scans_begin_without_information(pi_file: Path, vectors: Json) -> None:
    """Nothing is written until a good sample with a read-back; the loop begins from there, and not from the middle."""
    assert vectors["loop"]["mv"] is None
    rows = vectors["scans"]
    sent, known = part(rows, "by hand, before"), part(rows, "the first good sample")
    assert all(row["fault"] and row["mode"] == "HOLD" and row["mv"] is None for row in rows[:sent])
    assert rows[sent]["mv"] == rows[sent]["set_mv"]  # nobody but the operator knows
    again = part(rows, "by hand from nowhere known, read back")  # not known again
    assert all(row["fault"] and row["mv"] is None for row in rows[again:known])
    assert {bool(row["sample"]) for row in rows[again:known]} == {True, False}
    assert rows[known]["mv"] == rows[known]["sample"]["mv_applied"]
    (valve,) = Controller(pi_file).manifest.mv
    assert float.fromhex(rows[known]["mv"][0]) != valve.middle
    assert rows[known + 1]["sample"] is None  # a fault after that holds it
    assert rows[known + 1]["mv"] == rows[known]["mv"]
    others = next(k for k, row in enumerate(rows) if row["set_mode"] == "SHADOW")
    assert all(row["mv"] is not None for row in rows[known:others])


def test_the_scans_hold_commands_that_did_not_arrive(vectors: Json) -> None:
    """The loop goes on from where the MV stands, in each mode, and not from where the lost command left it."""
    rows = vectors["scans"]
    rows = rows[part(rows, "the first good sample") : part(rows, "sent by hand in AUTO")]
    lost = [k for k, row in enumerate(rows) if row["unwritten"]]
    found = {k: rows[k] for k in lost if rows[k]["sample"] and rows[k]["sample"]["mv_applied"] is not None}
    assert [rows[k]["mode"] for k in lost] == ["HOLD", "HOLD", "HOLD", "MANUAL", "HOLD", "HOLD"]
    assert [rows[k - 1]["mode"] for k in lost] == ["AUTO", "AUTO", "AUTO", "MANUAL", "AUTO", "HOLD"]
    for k, row in found.items():
        moved = float.fromhex(row["mv"][0]) - float.fromhex(rows[k - 1]["mv"][0])
        assert row["mv"] == row["sample"]["mv_applied"]
        assert abs(moved) >= 0.25 * float.fromhex(vectors["scale"]["mv"][0])
    silent, unread, after_others = sorted({*lost} - {*found}, key=lambda k: (rows[k]["sample"] is not None, k))
    assert rows[unread]["mv"] == rows[unread - 2]["mv"]  # what the plant had before the command that was lost
    assert rows[silent]["mv"] is rows[silent + 1]["mv"] is None
    assert rows[silent + 2]["mv"] == rows[silent + 2]["sample"]["mv_applied"]
    assert rows[after_others]["mv"] == rows[after_others - 1]["sample"]["mv_applied"]  # where others had moved it


def test_the_scans_hold_what_others_command(vectors: Json) -> None:
    """Nothing is written in SHADOW, nor after it before a sample tells; then never the MV of a scan before."""
    rows = vectors["scans"]
    rows = rows[: part(rows, "sent by hand in AUTO")]
    shadow = [k for k, row in enumerate(rows) if row["mode"] == "SHADOW"]
    assert all(rows[k]["mv"] is None for k in shadow)
    ends = [k + 1 for k in shadow if rows[k + 1]["mode"] != "SHADOW"]
    assert {rows[k]["set_mode"] for k in ends} == {"MANUAL", "HOLD", "AUTO"}
    silent = 0
    for k in ends:
        then, sample = rows[k], rows[k]["sample"]
        left = rows[k - 1]["sample"]["mv_applied"]
        back = sample and sample["mv_applied"]
        sound = back is not None and -2.0 <= float.fromhex(back[0]) <= 102.0
        if not sound and (then["fault"] or not sample):
            assert then["mv"] is None
            silent += 1
        elif then["mode"] != "AUTO":
            assert then["mv"] == (back or left)
            assert (then["mv"] != left) == sound
    assert silent == 1 + 2 * 3


@pytest.mark.parametrize("version", [1, 2, 3, 4, 5])
def test_an_old_kit_is_one_line_that_says_what_to_do(
    pi_file: Path, vectors: Json, answers: Json, tmp_path: Path, capsys: Capture, version: int
) -> None:
    an_old_version(vectors)
    (tmp_path / VECTORS).write_text(json.dumps(vectors | {"kit": version}))
    path = tmp_path / "answers.json"
    del answers["chained"]
    path.write_text(json.dumps(answers))
    assert main(["conformance", str(pi_file), str(tmp_path), "--check", str(path)]) == 2
    said = capsys.readouterr().err
    assert f"{VECTORS} has the version {version}; this release reads 6: write it again with" in said
    assert said.count("\n") == 1


def test_a_host_that_does_all_as_it_must_passes(pi_file: Path, kit: Path, vectors: Json, tmp_path: Path) -> None:
    verdict = judged(pi_file, kit, played(Controller(pi_file), vectors), tmp_path)
    assert verdict.passed
    assert verdict.identical
    assert verdict.one_step.largest == verdict.chained.largest == 0
    assert verdict.one_step.rows > 300
    assert verdict.chained.rows > verdict.one_step.rows  # the scans, too
    first, one_step, chained = verdict.text().split("\n")
    assert first == "Perfect, onnxruntime 0: passed"
    assert one_step.startswith("  one step: largest difference 0 of an entry's scale, allowed 1e-09, the same bits in")
    assert chained.startswith("  chained: sensitivity 0 of an entry's scale, allowed 1e-06, the same bits in")


def without_the_last(state: Array) -> Array:
    return np.concatenate([state[:-1], [0.0]])


CARRIED = "each step is right by itself: look at how the host keeps its state from one to the next"


def test_a_host_that_takes_a_part_of_the_given_state_fails_in_one_step(
    pi_file: Path, kit: Path, vectors: Json, tmp_path: Path
) -> None:
    verdict = judged(pi_file, kit, played(Controller(pi_file), vectors, takes=without_the_last), tmp_path)
    assert not verdict.passed
    assert verdict.one_step.largest > 1e-3
    assert verdict.chained.identical
    assert CARRIED not in verdict.text()


def test_a_host_that_carries_a_part_of_its_state_on_fails_chained(
    pi_file: Path, kit: Path, vectors: Json, tmp_path: Path
) -> None:
    verdict = judged(pi_file, kit, played(Controller(pi_file), vectors, keeps=without_the_last), tmp_path)
    assert not verdict.passed
    assert verdict.one_step.identical
    assert verdict.chained.largest > 1e-3
    assert CARRIED in verdict.text()


def test_a_host_that_loses_its_state_at_a_refused_step_fails_chained(
    pi_file: Path, kit: Path, vectors: Json, tmp_path: Path
) -> None:
    verdict = judged(pi_file, kit, played(Controller(pi_file), vectors, refused=np.zeros_like), tmp_path)
    assert not verdict.passed
    assert verdict.one_step.identical
    assert verdict.chained.rows - verdict.chained.same_bits == 12  # the steps after a refusal, and no other
    assert "(after a refusal)" in verdict.chained.where


@pytest.fixture(scope="module")
def chaotic_file(make_formula: Any, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Ricker's map, whose last digits grow until nothing is left of the others."""

    def formula(law: Any, sp: Any, pv: Any, dv: Any, mv_applied: Any, state: Any) -> Any:
        grown = 20.0 * (state + 0.5) * torch.exp(-(state + 0.5))
        return law.limited(40.0 + state[..., :1], mv_applied), grown - 0.5, state[..., :1]

    path = tmp_path_factory.mktemp("chaotic") / "law.onnx"
    export(make_formula(formula, 1, ("it",)), path, case="none", provenance={"from": "a test"})
    return path


def another_processor(values: Array) -> Array:
    """Some units in the last place."""
    return values * (1 + 4e-16)


def silent_copy(file: Path, to: Path) -> Path:
    """The same law in a file whose manifest does not say that it amplifies last digits."""
    model = onnx.ModelProto.FromString(file.read_bytes()[:-TRAILER_BYTES])
    del model.metadata_props[:]
    to.write_bytes(file_bytes(model.SerializeToString(), replace(Controller(file).manifest, provenance={})))
    return to


@pytest.mark.parametrize("told", [True, False])
def test_a_law_that_amplifies_last_digits_passes(chaotic_file: Path, tmp_path: Path, told: bool) -> None:
    """Equal in each step; its chain begins again before two right hosts part, as an unbroken one shows that they do."""
    file = chaotic_file if told else silent_copy(chaotic_file, tmp_path / "law.onnx")
    controller, kit = Controller(file), tmp_path / "kit"
    vectors = write_kit(controller, kit)
    verdict = judged(file, kit, played(controller, vectors, rounds=another_processor), tmp_path)
    assert verdict.passed, verdict.text()
    assert 0 < verdict.one_step.largest < 1e-15
    assert 10 * verdict.one_step.largest < verdict.chained.largest < 1e-10
    for row in vectors["steps"]:
        row["begins"] = row["cold"]
    verdict = judged(file, kit, played(controller, vectors, rounds=another_processor), tmp_path)
    assert verdict.one_step.largest < 1e-15  # it does not depend on how far a chained run parts
    assert verdict.chained.largest > 0.1
    assert CARRIED in verdict.text()


def test_the_chain_of_a_law_that_amplifies_nothing_begins_again_when_cold_alone(vectors: Json) -> None:
    assert all(row["begins"] is row["cold"] for row in vectors["steps"])


@pytest.mark.parametrize("share", [1e-10, 1e-12])
def test_a_host_that_is_right_in_each_step_is_right_chained(chaotic_file: Path, tmp_path: Path, share: float) -> None:
    """However far the digits go in which it differs, below what one step allows."""
    controller, kit = Controller(chaotic_file), tmp_path / "kit"
    vectors = write_kit(controller, kit)
    verdict = judged(chaotic_file, kit, played(controller, vectors, rounds=lambda v: v * (1 + share)), tmp_path)
    assert verdict.passed, verdict.text()
    assert verdict.one_step.largest == pytest.approx(share, rel=0.2)


def test_what_a_host_says_of_itself_acts_on_nobody(pi_file: Path, kit: Path, answers: Json, tmp_path: Path) -> None:
    answers |= {"host": "good\x1b[2J: passed\nplain", "onnxruntime": "1\u202e\u200e\nline"}
    answers["scans"][0]["mode"] = "\x1b[2J"
    text = judged(pi_file, kit, answers, tmp_path).text()
    assert all(line.isprintable() for line in text.split("\n"))
    assert text.split("\n")[0].endswith("FAILED")


def judged(file: Path, kit: Path, answers: Json, tmp_path: Path) -> Any:
    path = tmp_path / "answers.json"
    path.write_text(json.dumps(answers))
    return check(kit, path, Controller(file).sha256)


@pytest.mark.parametrize("share", [1e-12, 0.9e-9, 1.1e-9, 0.9e-6, 1.1e-6, 1e-3, math.nan])
@pytest.mark.parametrize("name", ["mv", "state_next", "info"])
@pytest.mark.parametrize(("run", "word", "allowed"), [("steps", "step", 1e-9), ("chained", "chained step", 1e-6)])
def test_a_difference_counts_as_a_share_of_the_scale(
    pi_file: Path,
    kit: Path,
    vectors: Json,
    answers: Json,
    tmp_path: Path,
    name: str,
    share: float,
    run: str,
    word: str,
    allowed: float,
) -> None:
    scale, old = float.fromhex(vectors["scale"][name][-1]), float.fromhex(answers[run][200][name][-1])
    answers[run][200][name][-1] = (old + share * scale).hex()
    verdict = judged(pi_file, kit, answers, tmp_path)
    assert verdict.passed is (share < allowed)
    assert not verdict.identical
    found, other = verdict.one_step, verdict.chained
    if run == "chained":
        found, other = other, found
    assert other.identical
    assert other.largest == 0
    assert found.same_bits == found.rows - 1
    assert found.largest == pytest.approx(share if math.isfinite(share) else math.inf, rel=1e-3)
    assert found.where.startswith(f"{word} 200 (")
    assert f": {name}[" in found.where


def test_one_bit_is_seen(pi_file: Path, kit: Path, answers: Json, tmp_path: Path) -> None:
    text = answers["steps"][100]["mv"][0]
    answers["steps"][100]["mv"][0] = math.nextafter(float.fromhex(text), math.inf).hex()
    verdict = judged(pi_file, kit, answers, tmp_path)
    assert verdict.passed
    assert verdict.one_step.same_bits == verdict.one_step.rows - 1
    assert not verdict.identical


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda a: a["steps"][-2].pop("refused"), "computed, but must be refused because of the input"),
        (lambda a: a["steps"].__setitem__(5, {"refused": "output"}), "refused because of the output, but must be"),
        (lambda a: a["steps"][-2].update(refused="output"), "of the output, but must be refused because of the input"),
        (lambda a: a["chained"][-2].pop("refused"), "chained step 352 (not finite): computed, but must be"),
        (lambda a: a["steps"].pop(), "steps: 353 are answered instead of 354"),
        (lambda a: a["chained"].pop(), "chained: 353 are answered instead of 354"),
        (lambda a: a["scans"].pop(), "are answered instead of"),
        (lambda a: a["steps"][7]["mv"].append("0x0p+0"), "step 7 (anywhere): mv: 2 numbers instead of 1"),
        (lambda a: a["scans"][5]["mv"].append("0x0p+0"), "mv: 2 numbers instead of 1"),
        (lambda a: a["scans"][11].update(mode="AUTO"), "mode is 'AUTO', but must be 'HOLD'"),
        (lambda a: a["scans"][11].update(fault=False), "fault is False, but must be True"),
        (lambda a: a["scans"][0].update(mv=a["scans"][4]["mv"]), "an MV is written, but where it stands is not known"),
        (lambda a: a["scans"][4].update(mv=None), "no MV is written, but one must be"),
    ],
)
def test_what_no_tolerance_excuses(
    pi_file: Path, kit: Path, answers: Json, tmp_path: Path, change: Any, words: str
) -> None:
    change(answers)
    verdict = judged(pi_file, kit, answers, tmp_path)
    assert not verdict.passed
    assert words in verdict.text()


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda a: a.update(sha256="0" * 64), "is for the controller with the SHA-256 000"),
        (lambda a: a.update(steps="all"), "the answers have no list of objects 'steps'"),
        (lambda a: a.pop("chained"), "the answers have no list of objects 'chained'"),
        (lambda a: a["steps"][3].update(mv=["1.5 K"]), "step 3 (anywhere): mv holds no hexadecimal float"),
        (lambda a: a["steps"][3].pop("info"), "step 3 (anywhere): info is 'None'; it must be a list"),
    ],
)
def test_answers_that_are_none_are_one_line(
    pi_file: Path, kit: Path, answers: Json, tmp_path: Path, capsys: Capture, change: Any, words: str
) -> None:
    change(answers)
    path = tmp_path / "answers.json"
    path.write_text(json.dumps(answers))
    assert main(["conformance", str(pi_file), str(kit), "--check", str(path)]) == 2
    said = capsys.readouterr().err
    assert words in said
    assert said.count("\n") == 1


def test_the_command_writes_and_checks(
    pi_file: Path, answers: Json, tmp_path: Path, kit: Path, capsys: Capture
) -> None:
    out, path = tmp_path / "new" / "kit", tmp_path / "answers.json"
    assert main(["conformance", str(pi_file), str(out)]) == 0
    said = capsys.readouterr().out
    assert all(words in said for words in PASS)
    beside = {pi_file.with_suffix(".json").name, "pi.batch1.onnx", VECTORS}
    assert {file.name for file in out.iterdir()} == {pi_file.name, *beside}
    assert (out / pi_file.name).read_bytes() == pi_file.read_bytes()
    assert (out / VECTORS).read_text() == (kit / VECTORS).read_text()  # the same every time
    manifest = json.loads((out / pi_file.with_suffix(".json").name).read_text())
    assert manifest["sha256"] == Controller(pi_file).sha256
    path.write_text(json.dumps(answers))
    assert main(["conformance", str(pi_file), str(out), "--check", str(path)]) == 0
    answers["scans"][5]["mode"] = "AUTO"
    path.write_text(json.dumps(answers))
    assert main(["conformance", str(pi_file), str(out), "--check", str(path)]) == 1
    assert "FAILED" in capsys.readouterr().out


def test_a_kit_beside_the_file_leaves_the_file_alone(pi_file: Path, tmp_path: Path) -> None:
    file = tmp_path / "law.onnx"
    file.write_bytes(pi_file.read_bytes())
    assert main(["conformance", str(file), str(tmp_path)]) == 0
    assert file.read_bytes() == pi_file.read_bytes()


def test_a_folder_that_cannot_be_written_is_one_line(pi_file: Path, tmp_path: Path, capsys: Capture) -> None:
    (tmp_path / "file").write_text("")
    assert main(["conformance", str(pi_file), str(tmp_path / "file" / "kit")]) == 2
    said = capsys.readouterr().err
    assert "the kit cannot be written to" in said
    assert said.count("\n") == 1


def test_a_kit_of_another_version_or_none_is_refused(pi_file: Path, kit: Path, vectors: Json, tmp_path: Path) -> None:
    path, digest = tmp_path / VECTORS, Controller(pi_file).sha256
    for text, words in (
        (json.dumps(vectors | {"kit": 9}), "has the version 9"),
        ("[]", "is no JSON object"),
        ("{", "cannot be read"),
    ):
        path.write_text(text)
        with pytest.raises(LoopwrightError, match=words):
            check(tmp_path, path, digest)


@given(st.lists(st.floats(width=64)))
def test_numbers_come_back_to_the_bit(values: list[float]) -> None:
    back = read(written(values), "here").tolist()
    assert all(a == b or (math.isnan(a) and math.isnan(b)) for a, b in zip(values, back, strict=True))
    assert [math.copysign(1, v) for v in back if v == 0] == [math.copysign(1, v) for v in values if v == 0]
