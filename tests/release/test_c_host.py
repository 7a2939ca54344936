"""The C host: built with sanitizers, every shipped controller to the bit, and damaged kits that it must not pass.

tools/onnxruntime_c.sh makes the folder with its header and library; ONNXRUNTIME_DIR names another one.
"""

from __future__ import annotations

import atexit
import json
import os
import re
import shutil
import subprocess
import sys
import time
from collections import Counter
from functools import cache
from pathlib import Path
from tempfile import mkdtemp

import pytest
from kits import DAMAGES, EMBED, ROOT, SHIPPED, SOME, an_old_version, kit_of, name, spoilt, verdict_on

CMAKE = shutil.which("cmake")
if CMAKE is None or shutil.which("cc") is None:
    pytest.skip("cmake or a C compiler is missing (apt install cmake gcc)", allow_module_level=True)

pytest_plugins = ["small_laws"]
PID = next(file for file in SHIPPED if name(file) == "thiosulfate_cstr-pid")
SANITIZERS = "-O1 -g -Werror -fsanitize=address,undefined -fno-sanitize-recover=all"


def run(*words: str | Path) -> subprocess.CompletedProcess[str]:
    return subprocess.run([str(w) for w in words], capture_output=True, text=True, timeout=120)


@cache
def onnxruntime() -> Path:
    """A folder with include/ and lib/, as a release archive has them."""
    if "ONNXRUNTIME_DIR" in os.environ:
        return Path(os.environ["ONNXRUNTIME_DIR"])
    folder = Path(mkdtemp(prefix="onnxruntime-"))
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    words = ["bash", str(ROOT / "tools" / "onnxruntime_c.sh"), str(folder)]
    made = subprocess.run(words, capture_output=True, text=True, env={**os.environ, "PYTHON": sys.executable})
    assert made.returncode == 0, made.stderr
    return folder


@pytest.fixture(scope="module")
def host(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Built as its page says."""
    assert CMAKE is not None
    folder, given = tmp_path_factory.mktemp("c"), (f"-DONNXRUNTIME_DIR={onnxruntime()}",)
    made = run(CMAKE, "-S", EMBED / "c", "-B", folder, *given, f"-DCMAKE_C_FLAGS={SANITIZERS}")
    assert made.returncode == 0, made.stderr
    made = run(CMAKE, "--build", folder)
    assert made.returncode == 0, made.stdout + made.stderr
    return folder / "host"


def changed_host(source: Path) -> Path:
    """A program of the host's loop with other parts around it; without cmake, which looks for a compiler each time."""
    program, library = source.with_suffix(""), onnxruntime() / "lib" / "libonnxruntime.so"
    options = ["-std=c11", "-Wall", "-Wextra", "-Wpedantic", *SANITIZERS.replace("-O1", "-O0").split()]
    include = ["-isystem", onnxruntime() / "include"]
    made = run("cc", *options, *include, source, library, f"-Wl,-rpath,{library.parent}", "-lm", "-o", program)
    assert made.returncode == 0, made.stderr
    return program


@pytest.mark.parametrize("file", SOME, ids=name)
def test_c_gives_the_bits_of_our_runtime(host: Path, file: Path, tmp_path: Path) -> None:
    done = run(host, "--conformance", kit_of(file), tmp_path / "answers.json")
    assert done.returncode == 0, done.stdout + done.stderr
    assert "largest difference 0, chained 0, 0 wrong" in done.stdout
    verdict = verdict_on(file, tmp_path / "answers.json")
    assert verdict.identical, verdict.text()
    assert verdict.one_step.rows > 300


def test_c_refuses_results_and_takes_measured_disturbances(host: Path, disobedient_file: Path, tmp_path: Path) -> None:
    """No shipped controller has measured disturbances or leaves its range; this one does both."""
    vectors = json.loads((kit_of(disobedient_file) / "vectors.json").read_text())
    refused = Counter(row.get("refused", "") for row in vectors["steps"])
    assert min(refused["output"], refused["input"], refused[""]) >= 15
    done = run(host, "--conformance", kit_of(disobedient_file), tmp_path / "answers.json")
    assert done.returncode == 0, done.stdout + done.stderr
    verdict = verdict_on(disobedient_file, tmp_path / "answers.json")
    assert verdict.identical, verdict.text()


# By damage: the largest difference in one step and chained, and how many answers are wrong.
EXPECTED = {
    "mv": "0.001, chained 0.001, 0",
    "state": "0.001, chained 0.001, 0",
    "given": r"[\d.e+]+, chained 0, 0",
    "refusal": "0, chained 0, 2",
    "mode": "0, chained 0, 1",
    "start": "0, chained 0, 1",
    "moved": "0, chained 0.8, 0",
}


@pytest.mark.parametrize("damage", DAMAGES)
def test_c_does_not_pass_a_damaged_kit(host: Path, damage: str, tmp_path: Path) -> None:
    done = run(host, "--conformance", spoilt(PID, tmp_path, DAMAGES[damage]))
    assert done.returncode == 1, done.stdout + done.stderr
    assert re.search(f"largest difference {EXPECTED[damage]} wrong", done.stdout), done.stdout


def test_c_refuses_an_old_kit(host: Path, tmp_path: Path) -> None:
    done = run(host, "--conformance", spoilt(PID, tmp_path, an_old_version))
    assert done.returncode == 2
    assert done.stdout == ""
    wanted = "the kit has the version 3, not 4: write it again with loopwright conformance FILE.onnx KIT"
    assert done.stderr == f"error: {wanted}\n"


def test_the_c_loop_scans_once_a_period(host: Path) -> None:
    began = time.monotonic()
    done = run(host, kit_of(PID) / "pid.onnx", "40", "0.02")
    assert time.monotonic() - began >= 39 * 0.02
    assert done.returncode == 0, done.stderr
    rows = [line.split() for line in done.stdout.splitlines()]
    places = [int(row[0]) for row in rows]
    assert places == sorted(set(places))  # a busy machine leaves some out, also at the start
    assert places[0] >= 0
    assert len(places) > 1
    assert all(float(row[1]) < 20 for row in rows)  # a later scan is one of the next period
    assert {row[4] for row in rows} == {"AUTO"}
    assert all(0 <= float(row[5]) <= 500 for row in rows)


def test_the_c_loop_writes_nothing_before_it_has_read_the_plant(tmp_path: Path) -> None:
    """The loop as it is shipped, on a plant that cannot be read at the first two scans and tells of each write."""
    text = (EMBED / "c" / "host.c").read_text()
    for place, more in (
        ("static bool plant_read(Plant *p, Sample *sample) {\n", "  if (p->k < 2) return p->k++, false;\n"),
        ("static bool plant_write(Plant *p, const double *mv) {\n", '  printf("written %g\\n", mv[0]);\n'),
    ):
        assert text.count(place) == 1
        text = text.replace(place, place + more)
    (tmp_path / "host.c").write_text(text)
    done = run(changed_host(tmp_path / "host.c"), kit_of(PID) / "pid.onnx", "60", "0.02")
    assert done.returncode == 0, done.stderr
    first, second, third, *_ = done.stdout.splitlines()
    assert first.endswith("HOLD - the plant cannot be read")
    assert second.endswith("HOLD - the plant cannot be read")
    assert third == "written 250"  # the read-back: where the made-up plant's actuator stands


def test_the_folder_of_onnxruntime_counts_from_where_the_user_stands(tmp_path: Path) -> None:
    """And a Python without onnxruntime is one line, not a traceback."""
    script = ["bash", str(ROOT / "tools" / "onnxruntime_c.sh"), "here"]
    bare = tmp_path / "python"
    bare.write_text(f'#!/bin/sh\nexec {sys.executable} -S -I "$@"\n')
    bare.chmod(0o755)
    for python, status in ((str(bare), 1), (sys.executable, 0)):
        environment = {**os.environ, "PYTHON": python}
        done = subprocess.run(script, capture_output=True, text=True, env=environment, cwd=tmp_path)
        assert done.returncode == status, done.stderr
        assert (tmp_path / "here").exists() is (status == 0)
        said = f"onnxruntime_c.sh: {python} has no package onnxruntime with a libonnxruntime.so"
        assert (done.stderr.startswith(said) and done.stderr.count("\n") == 1) if status else done.stderr == ""
    assert (tmp_path / "here" / "lib" / "libonnxruntime.so").is_file()
    assert (tmp_path / "here" / "include" / "onnxruntime_c_api.h").is_file()


def test_the_c_loop_meets_faults_as_ours(tmp_path: Path) -> None:
    """Write failures, operators' mistakes and gaps, which no vector holds: tests/release/loop_faults.c."""
    (tmp_path / "host.c").write_text(Path(__file__).with_name("loop_faults.c").read_text())
    shutil.copy(EMBED / "c" / "host.c", tmp_path / "embedded.h")
    done = run(changed_host(tmp_path / "host.c"), kit_of(PID) / "pid.onnx")
    assert done.returncode == 0, done.stdout + done.stderr
    assert done.stdout == "all as it must be\n"


@pytest.mark.parametrize(
    ("what", "words"),
    [
        ("cut", "pid.json is no JSON object"),
        ("foreign", "the file's SHA-256 is"),
        ("changed", "the file's SHA-256 is"),
        ("schema", "the JSON beside the file has another schema"),
        ("sizes", "the JSON beside the file has another n_state"),
        ("range", "the JSON beside the file has another mv"),
        ("unlimited", "the JSON beside the file has another mv"),
        ("without", "the JSON beside the file has another pv"),
        ("missing", "cannot be read: No such file or directory"),
    ],
)
def test_a_file_that_is_not_right_is_one_line_of_the_c_host(host: Path, what: str, words: str, tmp_path: Path) -> None:
    for suffix in (".onnx", ".json"):
        shutil.copy(kit_of(PID) / f"pid{suffix}", tmp_path)
    manifest, file = tmp_path / "pid.json", tmp_path / "pid.onnx"
    text = manifest.read_text()
    {
        "cut": lambda: manifest.write_text(text[:700]),
        "foreign": lambda: shutil.copy(next(f for f in SHIPPED if f.stem == "inc").with_suffix(".json"), manifest),
        "changed": lambda: file.write_bytes(file.read_bytes() + b"x"),
        "schema": lambda: manifest.write_text(text.replace('"schema": 1', '"schema": 2')),
        "sizes": lambda: manifest.write_text(text.replace('"n_state": 7', '"n_state": 8')),
        "range": lambda: manifest.write_text(text.replace('"high": 500.0', '"high": 5000.0')),
        "unlimited": lambda: manifest.write_text(text.replace('"high": 500.0', '"high": 500.0, "max_move": 1')),
        "without": lambda: manifest.write_text(text.replace('"pv": [', '"PV": [')),
        "missing": manifest.unlink,
    }[what]()
    done = run(host, file, "1", "0.01")
    assert done.returncode == 2
    assert done.stdout == ""
    assert done.stderr.startswith("error: ")
    assert done.stderr.count("\n") == 1
    assert words in done.stderr


def test_the_c_host_says_how_it_is_called(host: Path) -> None:
    done = run(host)
    assert done.returncode == 2
    assert done.stderr.startswith("usage: ")
