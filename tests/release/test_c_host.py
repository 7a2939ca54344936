"""The C host on onnxruntime: with sanitizers, every shipped controller to the bit, and damaged kits, which do not pass.

tools/onnxruntime_c.sh makes the folder with its header and library; ONNXRUNTIME_DIR names another one.
"""

from __future__ import annotations

import atexit
import os
import shutil
import subprocess
import sys
import time
from functools import cache, partial
from pathlib import Path
from tempfile import mkdtemp

import pytest
from kits import (
    DAMAGES,
    EMBED,
    KEEP_STATE,
    PID,
    ROOT,
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

CMAKE = shutil.which("cmake")
if CMAKE is None or shutil.which("cc") is None:
    pytest.skip("cmake or a C compiler is missing (apt install cmake gcc)", allow_module_level=True)

pytest_plugins = ["small_laws", "operated_laws", "course_files"]
ONNXRUNTIMES = EMBED / "c" / "onnxruntime"
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
    made = run(CMAKE, "-S", ONNXRUNTIMES, "-B", folder, *given, f"-DCMAKE_C_FLAGS={SANITIZERS}")
    assert made.returncode == 0, made.stderr
    made = run(CMAKE, "--build", folder)
    assert made.returncode == 0, made.stdout + made.stderr
    return folder / "host"


def changed_host(source: Path) -> Path:
    """A program of the host's loop with other parts around it; without cmake, which looks for a compiler each time."""
    program, library = source.with_suffix(""), onnxruntime() / "lib" / "libonnxruntime.so"
    options = ["-std=c11", "-Wall", "-Wextra", "-Wpedantic", *SANITIZERS.replace("-O1", "-O0").split()]
    include = ["-I", ONNXRUNTIMES, "-isystem", onnxruntime() / "include"]
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


@pytest.mark.parametrize("file", KEEP_STATE, ids=name)
def test_random_histories_go_in_c_as_in_our_runtime(host: Path, file: Path, tmp_path: Path) -> None:
    goes_through_random_scans(partial(run, host), file, tmp_path)


def test_c_refuses_results_and_takes_measured_disturbances(host: Path, disobedient_file: Path, tmp_path: Path) -> None:
    answers_refusals_and_disturbances(partial(run, host), disobedient_file, tmp_path / "answers.json")


def test_c_takes_what_is_to_come(host: Path, course_file: Path, tmp_path: Path) -> None:
    takes_what_is_to_come(partial(run, host), course_file, tmp_path / "answers.json")


def test_c_takes_what_operators_change(host: Path, operated_file: Path, tmp_path: Path) -> None:
    takes_what_operators_change(partial(run, host), operated_file, tmp_path / "answers.json")


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


STEERED = r"""
#define LOOPWRIGHT_NO_MAIN
#pragma GCC diagnostic ignored "-Wunused-function"
#include "host.c"
int main(int n, char **words) {
  (void)n;
  Controller c;
  Loop l;
  if (!controller_open(&c, words[1]) || !loop_open(&l, &c, AUTO, 1)) return printf("%s\n", c.words), 1;
  double pv[2] = {0.1, 0.2}, dv[1] = {0}, mv[2] = {0, 0}, values[64];
  Sample s = {.pv = pv, .dv = dv, .mv_applied = mv};
  memcpy(values, c.operate, sizeof *values * c.n_in[OPERATE]);
  values[operate_place(&c, "u0.use")] = 0.5;
  printf("%d ", controller_operate(&c, values));
  values[operate_place(&c, "u0.use")] = 0;
  printf("%d ", c.operate[operate_place(&c, "u0.use")] == 1);
  printf("%d ", controller_operate(&c, values));
  loop_scan(&l, &s);
  printf("%d ", !l.reason[0] && l.mv[0] == mv[0]);
  c.fresh[0] = c.fresh[1] = 0;
  loop_scan(&l, &s);
  printf("%d ", !l.reason[0]);
  c.fresh[1] = 0.5;
  loop_scan(&l, &s);
  printf("%s\n", l.reason);
  loop_close(&l);
  controller_close(&c);
  return 0;
}
"""


def test_a_program_around_the_c_host_steers_its_law(operated_file: Path, tmp_path: Path) -> None:
    """A value that is not allowed changes nothing; a flag that is none is a fault."""
    (tmp_path / "steered.c").write_text(STEERED.replace("host.c", str(ONNXRUNTIMES / "host.c")))
    done = run(changed_host(tmp_path / "steered.c"), kit_of(operated_file) / operated_file.name)
    assert done.returncode == 0, done.stdout + done.stderr
    assert done.stdout.startswith("0 1 1 1 1 fresh of y1 is 0.5; ")


@pytest.mark.parametrize("damage", DAMAGES)
def test_c_does_not_pass_a_damaged_kit(host: Path, damage: str, tmp_path: Path) -> None:
    fails_on_a_damaged_kit(partial(run, host), damage, EXPECTED[damage], tmp_path)


def test_c_refuses_an_old_kit(host: Path, tmp_path: Path) -> None:
    refuses_an_old_kit(partial(run, host), tmp_path)


def test_the_c_loop_scans_once_a_period(host: Path) -> None:
    began = time.monotonic()
    rows = scans_of_a_loop(partial(run, host))
    assert time.monotonic() - began >= 39 * 0.02
    assert all(0 <= float(row[5]) <= 500 for row in rows)


def test_the_c_loop_writes_nothing_before_it_has_read_the_plant(tmp_path: Path) -> None:
    """The loop as it is shipped, on a plant that cannot be read at the first two scans and tells of each write."""
    text = (ONNXRUNTIMES / "host.c").read_text()
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
    shutil.copy(ONNXRUNTIMES / "host.c", tmp_path / "embedded.h")
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
    refuses_in_one_line(partial(run, host), wrong_file(what, tmp_path), words)


def test_the_c_host_reads_a_manifest_in_a_time_that_grows_as_its_size(host: Path, tmp_path: Path) -> None:
    """A million escapes: read as they stand it is a moment, measured to the file's end at each it is hours."""
    for suffix in (".onnx", ".json"):
        shutil.copy(kit_of(PID) / f"pid{suffix}", tmp_path)
    beside = tmp_path / "pid.json"
    beside.write_text(beside.read_text().replace("{", '{"remark": "' + 1_000_000 * "\\u0041" + '",', 1))
    done = run(host, tmp_path / "pid.onnx", "1", "0.01")
    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith("0 ")


def test_the_c_host_says_how_it_is_called(host: Path) -> None:
    done = run(host)
    assert done.returncode == 2
    assert done.stderr.startswith("usage: ")
