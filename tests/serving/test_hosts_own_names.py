"""A host whose own modules have our folders' names imports both."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
ASKED = """
import pipeline.records, serving
from loopwright import serving as ours
from loopwright.pipeline.errors import PipelineError
from loopwright.serving import Controller, ControlLoop
print(serving.OWN, pipeline.records.OWN, ours.Controller is Controller, PipelineError.__module__)
"""


@pytest.mark.parametrize("warnings", ["error", "default"])
def test_a_host_may_have_a_serving_and_a_pipeline_of_its_own(tmp_path: Path, warnings: str) -> None:
    (tmp_path / "serving.py").write_text("OWN = 'host'\n")
    (tmp_path / "pipeline").mkdir()
    (tmp_path / "pipeline" / "__init__.py").touch()
    (tmp_path / "pipeline" / "records.py").write_text("OWN = 'plant'\n")
    environment = {**os.environ, "PYTHONPATH": str(ROOT / "tools/roots")}
    done = subprocess.run(
        [sys.executable, "-W", warnings, "-c", ASKED],
        cwd=tmp_path, env=environment, capture_output=True, text=True, timeout=60,
    )  # fmt: skip
    assert done.stderr == ""
    assert done.stdout.split() == ["host", "plant", "True", "loopwright.pipeline.errors"]


def test_nothing_is_importable_by_the_names_of_the_folders() -> None:
    """Neither name is in what an installation brings."""
    code = "import importlib.util as u; print([n for n in ('serving', 'pipeline') if u.find_spec(n)])"
    bare = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    done = subprocess.run(
        [sys.executable, "-c", code], cwd="/", env=bare, capture_output=True, text=True, timeout=60, check=True
    )
    assert done.stdout == "[]\n"
