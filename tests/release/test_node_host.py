"""The Node host: shipped controllers of every case to the bit, damaged kits, and its loop on a clock of the test's.

`npm ci` in examples/embed/node brings onnxruntime-node; without it these tests are skipped.
"""

from __future__ import annotations

import json
import re
import shutil
import subprocess
from pathlib import Path
from typing import Any

import pytest
from kits import (
    DAMAGES,
    EMBED,
    KEEP_STATE,
    PID,
    SOME,
    answers_refusals_and_disturbances,
    fails_on_a_damaged_kit,
    goes_through_random_scans,
    kit_of,
    name,
    refuses_an_old_kit,
    refuses_in_one_line,
    scans_of_a_loop,
    takes_what_is_to_come,
    takes_what_operators_change,
    verdict_on,
    wrong_file,
)

NODE = shutil.which("node")
if NODE is None or not (EMBED / "node" / "node_modules").is_dir():
    pytest.skip("node or its packages are missing (npm ci in examples/embed/node)", allow_module_level=True)

pytest_plugins = ["small_laws", "operated_laws", "course_files"]


def run(*words: str | Path) -> subprocess.CompletedProcess[str]:
    command = [str(NODE), str(EMBED / "node" / "host.mjs"), *map(str, words)]
    return subprocess.run(command, capture_output=True, text=True, timeout=120)


# The host's program with one kit after another in place of its arguments: Node and onnxruntime are loaded once.
KITS = """
const [host, ...paths] = process.argv.slice(1);
for (let i = 0; i < paths.length; i += 2) {
  process.argv = [process.argv[0], host, "--conformance", paths[i], paths[i + 1]];
  process.exitCode = undefined;
  await import(`${host}?${i}`);
  console.log(`ended with ${process.exitCode}`);
}
process.exitCode = 0;
"""


@pytest.fixture(scope="module")
def conformed(tmp_path_factory: pytest.TempPathFactory) -> dict[Path, tuple[str, Path]]:
    """Controller file -> what the host says of its kit and how it ends, and its answers."""
    folder = tmp_path_factory.mktemp("answers")
    answers = {file: folder / f"{name(file)}.json" for file in SOME}
    paths = [str(path) for file in SOME for path in (kit_of(file), answers[file])]
    command = [str(NODE), "--input-type=module", "-e", KITS, str(EMBED / "node" / "host.mjs"), *paths]
    done = subprocess.run(command, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stdout + done.stderr
    said = re.findall(r"(.*?ended with \S+)\n", done.stdout, re.DOTALL)
    return {file: (words, answers[file]) for file, words in zip(SOME, said, strict=True)}


@pytest.mark.parametrize("file", SOME, ids=name)
def test_node_gives_the_bits_of_our_runtime(file: Path, conformed: dict[Path, tuple[str, Path]]) -> None:
    """On another release of onnxruntime than ours, too."""
    said, answers = conformed[file]
    assert said.endswith("ended with 0")
    assert "largest difference 0.00, chained 0.00, 0 wrong" in said
    verdict = verdict_on(file, answers)
    assert verdict.identical, verdict.text()
    assert verdict.one_step.rows > 300


@pytest.mark.parametrize("file", KEEP_STATE, ids=name)
def test_random_histories_go_in_node_as_in_our_runtime(file: Path, tmp_path: Path) -> None:
    goes_through_random_scans(run, file, tmp_path)


def test_node_refuses_results_and_takes_measured_disturbances(disobedient_file: Path, tmp_path: Path) -> None:
    answers_refusals_and_disturbances(run, disobedient_file, tmp_path / "answers.json")


def test_node_takes_what_is_to_come(course_file: Path, tmp_path: Path) -> None:
    takes_what_is_to_come(run, course_file, tmp_path / "answers.json")


def test_node_takes_what_operators_change(operated_file: Path, tmp_path: Path) -> None:
    takes_what_operators_change(run, operated_file, tmp_path / "answers.json")


# By damage: the largest difference in one step and chained, and how many answers are wrong.
EXPECTED = {
    "mv": "0.00100, chained 0.00100, 0",
    "state": "0.00100, chained 0.00100, 0",
    "given": r"[\d.e+]+, chained 0.00, 0",
    "refusal": "0.00, chained 0.00, 2",
    "mode": "0.00, chained 0.00, 1",
    "start": "0.00, chained 0.00, 1",
    "moved": "0.00, chained 0.800, 0",
}


STEERED = """
import { readFileSync } from "node:fs";
import { createRequire } from "node:module";
const [host, file] = process.argv.slice(1);
const ort = createRequire(host)("onnxruntime-node");
const { Controller, Loop, Operate } = await import(host.replace("node/host", "javascript/controller"));
const manifest = JSON.parse(readFileSync(file.replace("onnx", "json")));
const controller = await Controller.load(ort, readFileSync(file), manifest, "cpu");
const loop = new Loop(controller, { sp: [0, 0], mode: "AUTO", recoverAfter: 1 });
const good = { pv: [0.1, 0.2], dv: [0], mv_applied: [0.3, 0], age_s: 0 };
const refused = [], found = [];
const bads = [{ "u0.use": 0.5 }, { "y0.low": 1, "y0.high": 0 }, { "u0.rest": "0" }, { "u0.cost": NaN }, { nothing: 1 }];
for (const bad of bads)
  try { loop.setOperate(bad); } catch (error) { refused.push(error.because); }
const byDefault = () => loop.operate.every((value, i) => value === manifest.operate[i].default);
const unchanged = byDefault();
loop.setOperate({ "u0.use": 0 });
for (const fresh of [undefined, [1, 0], [0, 0], [1, 0.5], [1], [NaN, 1]]) {
  const scan = await loop.scan({ ...good, fresh });
  found.push([scan.mv[0], scan.mode, scan.law && scan.law[1]]);
}
const other = (entries) => Object.create(controller, { operate: { value: new Operate(entries) } });
const valve = { group: "mv", signal: "u0", unit: "", low: 0, high: 1 };
const some = [{ ...valve, what: "use", default: 1 }, { ...valve, what: "cost", default: 0.5 }];
const taken = [[], some, manifest.operate].map((entries) => {
  loop.replace(other(entries));
  return loop.operate.filter((value, i) => value !== entries[i].default);
});
let narrow = "";
try { loop.replace(other([{ ...valve, what: "use", default: 1, low: 1 }])); } catch (error) { narrow = error.because; }
const kept = loop.operate.length;
console.log(JSON.stringify({ refused, unchanged, found, taken, narrow, kept: kept === manifest.operate.length }));
"""


def test_a_program_around_the_node_host_steers_its_law(operated_file: Path) -> None:
    """A value that is not allowed changes nothing; a flag that is none is a fault."""
    host, file = EMBED / "node" / "host.mjs", kit_of(operated_file) / operated_file.name
    command = [str(NODE), "--input-type=module", "-e", STEERED, str(host), str(file)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60)
    assert done.returncode == 0, done.stderr
    told = json.loads(done.stdout)
    assert told["refused"] == ["input"] * 5
    assert told["unchanged"]
    assert told["taken"] == [[], [0], [0]]  # u0.use, which somebody set, and nothing else
    assert (told["narrow"], told["kept"]) == ("input", True)
    assert [mv for mv, *_ in told["found"]] == [0.3] * 6  # out of use, or held
    assert [mode for _, mode, _ in told["found"]] == ["AUTO"] * 3 + ["HOLD"] * 3


@pytest.mark.parametrize("damage", DAMAGES)
def test_node_does_not_pass_a_damaged_kit(damage: str, tmp_path: Path) -> None:
    fails_on_a_damaged_kit(run, damage, EXPECTED[damage], tmp_path)


def test_node_refuses_an_old_kit(tmp_path: Path) -> None:
    refuses_an_old_kit(run, tmp_path)


def test_the_node_loop_scans_once_a_period() -> None:
    scans_of_a_loop(run)


LOOP = """
import { readFileSync } from "node:fs";
import { createRequire } from "node:module";
const [host, file, unread, unwritten, moved] = process.argv.slice(1).map((w) => (isNaN(w) ? w : Number(w)));
const ort = createRequire(host)("onnxruntime-node");
const { Controller, Loop } = await import(host.replace("node/host", "javascript/controller"));
const { MadeUpPlant, run, start } = await import(host.replace("node/host", "javascript/run"));
const manifest = JSON.parse(readFileSync(file.replace("onnx", "json")));
const controller = await Controller.load(ort, readFileSync(file), manifest, "cpu");
const loop = new Loop(controller, { ...start(controller.manifest), mode: "AUTO", recoverAfter: 2 });
let written = [];
class Plant extends MadeUpPlant {
  read() {
    const sample = super.read();
    if (this.k <= unread) throw new Error("no answer yet");
    if (this.k === 4) throw new Error("no answer");
    if (moved && this.k === unwritten + 1) return { ...sample, pv: [0.499, 300], mv_applied: [600] }; // no such MV
    return { ...sample, pv: [0.499, 300] };
  }
  write(mv) {
    if (this.k === unwritten) {
      if (moved) this.mv = [moved]; // by its operator
      throw new Error("no way");
    }
    written.push([...mv]);
    super.write(mv);
  }
}
let time = 100, scans = [];
const plant = new Plant(controller.manifest);
await run(loop, plant, {
  scans: 30,
  period: 1,
  now: () => time,
  sleep: async (seconds) => { time += seconds * 0.7 + (seconds < 1e-3 ? 0.25 : 0); }, // early at first, late in the end
  seen: ({ k, late, mode, mv, reason }) => {
    scans.push({ k, late, mode, mv: mv && [...mv], reason, state: [...loop.state] });
    if (k === 15) time += 2.5; // a whole period passes
    if (k === 20) time += 7.5; // six of them
  },
});
let refused = [];
try { loop.setMv([200]); } catch (error) { refused.push(error.message); }
loop.setMode("MANUAL");
loop.setMv([200]);
loop.unwritten("no way");
try { loop.setMv([210]); } catch (error) { refused.push(error.message); }
// After a lost command: no read-back at all gives the old MV back, but not after an implausible one.
loop.setMode("HOLD");
const sample = { pv: [0.499, 300], dv: [], mv_applied: null, age_s: 0 };
const nothingReadBack = await loop.scan(sample);
loop.unwritten("no way");
await loop.scan({ ...sample, mv_applied: [600] });
const afterAnImplausibleOne = await loop.scan(sample);
for (const bad of [[2], [NaN], [], [0.1, 0.2]])
  try { loop.setSp(bad); } catch (error) { refused.push(error.message); }
const lost = [nothingReadBack.mv, afterAnImplausibleOne.mv];
console.log(JSON.stringify({ scans, lost, refused, written, sp: [...loop.sp] }));
"""


def ran(unread: int, unwritten: int, moved: float = 0.0) -> dict[str, Any]:
    """A loop on a clock of the test's, two gaps, and a plant that is not read at the first ``unread`` scans.

    Nor can it be read at the fourth one, nor written at the one of the number ``unwritten``; there its operator then
    sets the MV to ``moved``, and the next read-back is implausible.
    """
    host, file = EMBED / "node" / "host.mjs", kit_of(PID) / "pid.onnx"
    command = [
        str(NODE),
        "--input-type=module",
        "-e",
        LOOP,
        str(host),
        str(file),
        *map(str, (unread, unwritten, moved)),
    ]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60)
    assert done.returncode == 0, done.stderr
    found: dict[str, Any] = json.loads(done.stdout)
    return found


@pytest.fixture(scope="module")
def told() -> dict[str, Any]:
    return ran(0, 10)


def test_nothing_is_written_in_node_before_the_plant_is_known() -> None:
    """Not read at two scans; the first command after that does not arrive, and the fourth scan is a fault again."""
    found = ran(2, 3)
    scans = {scan["k"]: scan for scan in found["scans"]}
    assert [scans[k]["mv"] for k in range(4)] == [None] * 4
    assert all(scans[k]["mode"] == "HOLD" for k in range(5))
    stands = scans[4]["mv"]
    assert stands == [250.0]  # the read-back
    assert found["written"][0] == stands
    assert scans[5]["mode"] == "AUTO"


def test_lateness_does_not_become_drift_in_node(told: dict[str, Any]) -> None:
    places = [scan["k"] for scan in told["scans"]]
    assert places == [k for k in range(30) if k not in {16, *range(21, 27)}]
    assert all(0 <= scan["late"] < 1 for scan in told["scans"])
    assert sum(scan["late"] > 0.2 for scan in told["scans"]) > 20  # each is late, none the later for it


def test_faults_hold_the_mv_in_node(told: dict[str, Any]) -> None:
    scans = {scan["k"]: scan for scan in told["scans"]}
    assert [k for k, scan in scans.items() if scan["mode"] == "HOLD"] == [3, 4, 9, 10]
    assert scans[3]["reason"] == "the plant cannot be read"
    assert scans[9]["reason"] == "the plant cannot be written: no way"
    assert scans[3]["mv"] == scans[2]["mv"]
    assert scans[9]["mv"] is None  # the last command did not arrive: where the MV stands is not known
    for fault in (3, 9):
        assert scans[fault + 1]["mv"] == scans[fault - 1]["mv"]
        assert scans[fault - 1]["mv"] != scans[fault - 2]["mv"]  # the law was moving it
        assert not any(scans[fault]["state"])


def test_a_plant_that_reads_nothing_back_gets_its_old_mv_back_in_node(told: dict[str, Any]) -> None:
    assert told["lost"] == [[200], None]  # none after an implausible read-back: the plant does read back


def test_what_the_plant_s_operator_set_meanwhile_is_held_in_node() -> None:
    """A command does not arrive, the MV is moved, and the next read-back is implausible."""
    found = ran(0, 10, 350.0)
    scans = {scan["k"]: scan for scan in found["scans"]}
    assert [scans[k]["mv"] for k in (9, 10)] == [None, None]
    assert scans[10]["reason"].startswith("applied MV T_j is 600 K, outside its range")
    assert scans[11]["mv"] == found["written"][9] == [350.0]  # nine were written before
    assert [scans[k]["mode"] for k in (9, 10, 11, 12)] == ["HOLD", "HOLD", "HOLD", "AUTO"]
    assert abs(scans[12]["mv"][0] - 350) < 1  # the law begins there


STRANGE = """
import { readFileSync } from "node:fs";
import { createRequire } from "node:module";
const [host, file] = process.argv.slice(1);
const ort = createRequire(host)("onnxruntime-node");
const { Controller, Loop } = await import(host.replace("node/host", "javascript/controller"));
const { run } = await import(host.replace("node/host", "javascript/run"));
const manifest = JSON.parse(readFileSync(file.replace("onnx", "json")));
const controller = await Controller.load(ort, readFileSync(file), manifest, "cpu");
const loop = new Loop(controller, { sp: [0.5], mode: "AUTO", recoverAfter: 1 });
const good = { pv: [0.499, 300], dv: [], mv_applied: [250], age_s: 0 };
const thrown = (what) => { throw what; };
const reads = [
  () => undefined, () => null, () => 7, () => "good", () => ({}), () => Promise.reject(), () => thrown(null),
  () => ({ ...good, pv: [Symbol(), 300] }), () => ({ ...good, pv: undefined }), () => ({ ...good, age_s: Symbol() }),
  () => ({ ...good, mv_applied: [Symbol()] }), () => ({ ...good, mv_applied: 0 }), () => ({ ...good, pv: [1n, 300] }),
  () => ({ get pv() { return thrown(Object.create(null)); } }), () => good,
];
const writes = [
  () => {}, () => thrown(undefined), () => Promise.reject(Symbol("no")), () => thrown(Object.create(null)),
  (mv) => mv.fill(NaN), () => {},
];
let time = 0, k = 0, w = 0, scans = [];
await run(loop, { read: () => (reads[k++] ?? (() => good))(), write: (mv) => writes[Math.min(w++, 5)](mv) }, {
  scans: reads.length + writes.length,
  period: 1,
  now: () => time,
  sleep: async (seconds) => { time += seconds; },
  seen: ({ mode, mv, reason }) => scans.push({ mode, mv: mv && [...mv], reason }),
});
console.log(JSON.stringify({ scans, reads: reads.length }));
"""


def test_the_node_loop_survives_whatever_its_plant_returns_and_throws() -> None:
    host, file = EMBED / "node" / "host.mjs", kit_of(PID) / "pid.onnx"
    command = [str(NODE), "--input-type=module", "-e", STRANGE, str(host), str(file)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60)
    assert done.returncode == 0, done.stderr
    found = json.loads(done.stdout)
    blind, seeing = found["scans"][: found["reads"] - 1], found["scans"][found["reads"] - 1 :]
    assert all(scan["mode"] == "HOLD" and scan["reason"] and scan["mv"] is None for scan in blind)
    assert [blind[k]["reason"] for k in (0, 1, 5, 6)] == ["the plant cannot be read"] * 4
    assert blind[8]["reason"] == "PV has no values instead of 2"
    assert len(seeing) == 7
    lost = [scan["reason"] for scan in seeing if scan["mv"] is None]
    whys = ("undefined", "Symbol(no)", "an error without words")
    assert lost == [f"the plant cannot be written: {why}" for why in whys]
    assert seeing[-1]["mode"] == "AUTO"
    assert all(0 <= scan["mv"][0] <= 500 for scan in seeing if scan["mv"] is not None)


BY_HAND = """
import { readFileSync } from "node:fs";
import { createRequire } from "node:module";
const [host, file] = process.argv.slice(1);
const ort = createRequire(host)("onnxruntime-node");
const { Controller, Loop } = await import(host.replace("node/host", "javascript/controller"));
const manifest = JSON.parse(readFileSync(file.replace("onnx", "json")));
const controller = await Controller.load(ort, readFileSync(file), manifest, "cpu");
controller.manifest.mv[0].max_move = 30;
const good = { pv: [0.4, 300], dv: [], mv_applied: [200], age_s: 0 };
const refused = { ...good, pv: [NaN, 300] }, silent = { ...good, mv_applied: null };
const told = [];
const start = async (first) => {
  const loop = new Loop(controller, { sp: [0.5], mode: "MANUAL" });
  if (first) await loop.scan(first);
  return loop;
};
const at = async (loop, sample) => told.push((await loop.scan(sample)).mv?.[0] ?? null);
let loop = await start(good);
loop.setMv([275]);
await at(loop, good);
loop.unwritten("the plant cannot be written");
await at(loop, silent);
await at(loop, refused);
await at(loop, null);
await at(loop, good);
loop.setMv([0]);
await at(loop, good);
loop.setMode("HOLD");
loop.setMode("MANUAL");
await at(loop, good);
loop.setMv([0]);
await at(loop, good);
loop.unwritten("the plant cannot be written");
await at(loop, good);
await at(loop, good);
loop = await start();
loop.setMv([275]);
await at(loop, good);
loop = await start();
loop.setMv([275]);
await at(loop, silent);
console.log(JSON.stringify(told));
"""


def test_the_node_loop_moves_no_mv_by_hand_faster_than_it_may() -> None:
    host, file = EMBED / "node" / "host.mjs", kit_of(PID) / "pid.onnx"
    command = [str(NODE), "--input-type=module", "-e", BY_HAND, str(host), str(file)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60)
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout) == [230, 230, 260, 275, 275, 245, 245, 215, 200, 200, 230, 275]


def test_what_an_operator_may_not_set_is_refused_in_node(told: dict[str, Any]) -> None:
    assert len(told["refused"]) == 6
    assert told["refused"][0] == "the MV is set by hand in MANUAL only; the loop is in AUTO"
    assert told["refused"][1].startswith("the last MV did not reach the plant")
    assert told["sp"] == [0.5]


@pytest.mark.parametrize(
    ("what", "words"),
    [
        ("changed", "the file's SHA-256 is"),
        ("missing", "no such file"),
        ("foreign", "the file's SHA-256 is"),
        ("range", "the JSON beside the file has another mv"),
        ("unlimited", "the JSON beside the file has another mv"),
    ],
)
def test_a_file_that_is_not_right_is_one_line_of_the_node_host(what: str, words: str, tmp_path: Path) -> None:
    refuses_in_one_line(run, wrong_file(what, tmp_path), words)
