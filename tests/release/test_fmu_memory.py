"""The FMU's own C under the address, leak and undefined-behaviour sanitizers: fmu_driver.c plays the kit through it."""

from __future__ import annotations

import os
import subprocess
from pathlib import Path

import numpy as np
import pytest
from controller_fmus import MISSING, answers_of, controller_of, tools, unpacked

from loopwright.pipeline.hosts.fmu.folder import token_of

if MISSING:
    pytest.skip(MISSING, allow_module_level=True)
pytest.importorskip("fmpy")

SANITIZED = "-std=c11 -O1 -g -Wall -Wextra -Wno-unused-function -Werror -fsanitize=address,undefined"


PID = "thiosulfate_cstr/pid"


def built(of: str, fmi: int, folder: Path, extra: tuple[str, ...] = (), *, onnxruntime: bool = False) -> Path:
    """The driver, or the test fails with what the compiler says."""
    driver, source, made_by = (
        folder / "driver",
        Path(__file__).with_name("fmu_driver.c"),
        tools(onnxruntime=onnxruntime),
    )
    sources = unpacked(of, fmi, onnxruntime=onnxruntime) / "sources"
    parts = [source, sources / "law.c"]
    if made_by.library is not None:
        parts = [source, folder / made_by.library_name]
        parts[1].symlink_to(made_by.library)
    headers = [f"-I{sources}", *(f"-isystem{path}" for path in made_by.includes)]
    words = ["cc", *SANITIZED.split(), "-fno-sanitize-recover=all", f"-DFMI={fmi}", *extra, *headers, *map(str, parts)]
    done = subprocess.run(
        [*words, f"-Wl,-rpath,{folder}", "-lm", "-o", str(driver)], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    return driver


def steps_of(of: str, to: Path, *, onnxruntime: bool = False) -> int:
    """Write the kit's steps as fmu_driver.c reads them, each with its state; how many."""
    controller = controller_of(of)
    groups = [n for n in controller.manifest.inputs if n != "state"]
    held, lines = np.zeros(0), []
    answers = answers_of(of, onnxruntime=onnxruntime)
    for answer in answers:
        if answer.step is not None:
            held = np.concatenate([answer.step.mv, answer.step.info])
        values = np.concatenate([answer.state, *(answer.given.inputs[group] for group in groups), held])
        head = f"{int(answer.given.cold)} {int(answer.step is None)}"
        lines.append(" ".join([head, *(float(value).hex() for value in values)]))
    to.write_text("\n".join(lines) + "\n")
    return len(lines)


def played(driver: Path, of: str, fmi: int, folder: Path, *, onnxruntime: bool = False, **also: str) -> str:
    """What the driver says of all steps, with these variables in its environment."""
    steps_of(of, folder / "steps", onnxruntime=onnxruntime)
    resources = unpacked(of, fmi, onnxruntime=onnxruntime) / "resources"
    done = subprocess.run(
        [str(driver), str(resources), token_of(controller_of(of)), str(folder / "steps")],
        capture_output=True,
        text=True,
        env={**os.environ, **also},
        timeout=120,
        check=False,
    )
    return done.stdout if done.returncode == 0 else done.stderr


@pytest.mark.parametrize("of", [PID, "jacketed_batch_reactor/fuzzy_feedforward_observer"])
@pytest.mark.parametrize("fmi", [2, 3])
def test_the_fmu_neither_leaks_nor_reads_beyond_its_memory(fmi: int, of: str, tmp_path: Path) -> None:
    assert played(built(of, fmi, tmp_path), of, fmi, tmp_path) == f"{len(answers_of(of))} steps\n"


def test_nor_does_one_with_onnxruntime(tmp_path: Path) -> None:
    driver = built(PID, 2, tmp_path, onnxruntime=True)
    assert played(driver, PID, 2, tmp_path, onnxruntime=True) == f"{len(answers_of(PID))} steps\n"


def test_a_leak_of_the_fmu_would_be_found(tmp_path: Path) -> None:
    """The same with an instance that is never freed."""
    driver = built(PID, 3, tmp_path, ("-DLEAK", "-O0"))
    assert "LeakSanitizer: detected memory leaks" in played(driver, PID, 3, tmp_path)


@pytest.mark.parametrize("onnxruntime", [False, True])
def test_a_program_with_decimal_commas_can_load_the_fmu(onnxruntime: bool, tmp_path: Path) -> None:
    """The manifest's numbers have points, and strtod obeys the locale of the program around it."""
    (tmp_path / "comma").write_text('comment_char %\nescape_char /\nLC_NUMERIC\ndecimal_point ","\nthousands_sep ""\n'
                                    "grouping -1\nEND LC_NUMERIC\n")  # fmt: skip
    (tmp_path / "locales").mkdir()
    words = ["localedef", "-c", "-i", str(tmp_path / "comma"), str(tmp_path / "locales" / "comma")]
    subprocess.run(words, capture_output=True, check=False)  # it warns of other categories; the driver needs this one
    driver = built(PID, 3, tmp_path, onnxruntime=onnxruntime)
    environment = {"LOCPATH": str(tmp_path / "locales"), "DRIVER_LOCALE": "comma"}
    said = played(driver, PID, 3, tmp_path, onnxruntime=onnxruntime, **environment)
    assert said == f"{len(answers_of(PID))} steps\n"
