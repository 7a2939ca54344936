"""The FMU's own C under the address, leak and undefined-behaviour sanitizers: fmu_driver.c plays the kit through it."""

from __future__ import annotations

import os
import subprocess
from collections.abc import Callable
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from controller_fmus import MISSING, answers_of, controller_of, tools, unpacked

from loopwright.pipeline.hosts.fmu.compiling import HOSTS, SOURCES
from loopwright.pipeline.hosts.fmu.folder import token_of

if MISSING:
    pytest.skip(MISSING, allow_module_level=True)
pytest.importorskip("fmpy")

SANITIZED = "-std=c11 -O1 -g -Wall -Wextra -Wno-unused-function -Werror -fsanitize=address,undefined"


def built(fmi: int, folder: Path, extra: tuple[str, ...] = ()) -> Path:
    """The driver, or the test fails with what the compiler says."""
    driver, source = folder / "driver", Path(__file__).with_name("fmu_driver.c")
    headers = [f"-I{SOURCES}", f"-I{HOSTS / 'c'}", *(f"-isystem{path}" for path in tools().includes)]
    link = (tools().library_name, tools().library)
    (folder / link[0]).symlink_to(link[1])
    words = ["cc", *SANITIZED.split(), "-fno-sanitize-recover=all", f"-DFMI={fmi}", *extra, *headers, str(source)]
    done = subprocess.run(
        [*words, str(folder / link[0]), f"-Wl,-rpath,{folder}", "-lm", "-o", str(driver)],
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
    return driver


@pytest.fixture(scope="module")
def driver_of(tmp_path_factory: pytest.TempPathFactory) -> Callable[[int], Path]:
    """The driver of a version of FMI, compiled once for all tests."""
    return cache(lambda fmi: built(fmi, tmp_path_factory.mktemp("driver")))


def steps_of(of: str, to: Path) -> int:
    """Write the kit's steps as fmu_driver.c reads them; how many."""
    controller = controller_of(of)
    groups = [n for n in controller.manifest.inputs if n != "state"]
    held, lines = np.zeros(0), []
    for answer in answers_of(of):
        if answer.step is not None:
            held = np.concatenate([answer.step.mv, answer.step.info])
        values = np.concatenate([*(answer.given.inputs[group] for group in groups), held])
        head = f"{int(answer.given.cold)} {int(answer.step is None)}"
        lines.append(" ".join([head, *(float(value).hex() for value in values)]))
    to.write_text("\n".join(lines) + "\n")
    return len(lines)


def played(
    driver: Path, of: str, fmi: int, folder: Path, environment: dict[str, str] | None = None
) -> subprocess.CompletedProcess[str]:
    steps_of(of, folder / "steps")
    resources = unpacked(of, fmi) / "resources"
    return subprocess.run(
        [str(driver), str(resources), token_of(controller_of(of)), str(folder / "steps")],
        capture_output=True,
        text=True,
        env={**os.environ, **(environment or {})},
        timeout=120,
    )


@pytest.mark.parametrize("fmi", [2, 3])
def test_the_fmu_neither_leaks_nor_reads_beyond_its_memory(
    fmi: int, driver_of: Callable[[int], Path], tmp_path: Path
) -> None:
    driver = driver_of(fmi)
    for of in ("thiosulfate_cstr/pid", "jacketed_batch_reactor/fuzzy_feedforward_observer"):
        done = played(driver, of, fmi, tmp_path)
        assert done.returncode == 0, done.stderr
        assert done.stdout == f"{len(answers_of(of))} steps\n"


def test_a_leak_of_the_fmu_would_be_found(tmp_path: Path) -> None:
    """The same with an instance that is never freed."""
    driver = built(3, tmp_path, ("-DLEAK", "-O0"))
    done = played(driver, "thiosulfate_cstr/pid", 3, tmp_path)
    assert done.returncode != 0
    assert "LeakSanitizer: detected memory leaks" in done.stderr


def test_a_program_with_decimal_commas_can_load_the_fmu(driver_of: Callable[[int], Path], tmp_path: Path) -> None:
    """The manifest's numbers have points, and strtod obeys the locale of the program around it."""
    (tmp_path / "comma").write_text('comment_char %\nescape_char /\nLC_NUMERIC\ndecimal_point ","\nthousands_sep ""\n'
                                    "grouping -1\nEND LC_NUMERIC\n")  # fmt: skip
    (tmp_path / "locales").mkdir()
    words = ["localedef", "-c", "-i", str(tmp_path / "comma"), str(tmp_path / "locales" / "comma")]
    subprocess.run(words, capture_output=True)  # it warns of the other categories; the driver needs this one
    environment = {"LOCPATH": str(tmp_path / "locales"), "DRIVER_LOCALE": "comma"}
    done = played(driver_of(3), "thiosulfate_cstr/pid", 3, tmp_path, environment)
    assert done.returncode == 0, done.stderr
