"""Controllers that read ``ahead``, once a session. Loaded by ``pytest_plugins``, not imported."""

from __future__ import annotations

from pathlib import Path

import pytest
from identified_models import random_model
from predictive_loops import law_of

from loopwright.pipeline.export.gate import export
from loopwright.serving import Controller


@pytest.fixture(scope="session")
def course_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two controlled variables, two MVs, one measured disturbance; a linear model, no ``operate``."""
    path = tmp_path_factory.mktemp("controller") / "course.onnx"
    law = law_of(random_model(3, n_y=2, n_mv=2, n_dv=1, n_hidden=0), horizon=12, preview="course")
    export(law, path, case="made", provenance={})
    return path


@pytest.fixture(scope="session")
def previewing(course_file: Path) -> Controller:
    """The controller of ``course_file``."""
    return Controller(course_file)


@pytest.fixture(scope="session")
def operated_previewing(tmp_path_factory: pytest.TempPathFactory) -> Controller:
    """The same signals, a network, ``operate`` and ``fresh`` too, and a longer horizon."""
    path = tmp_path_factory.mktemp("controller") / "operated_course.onnx"
    law = law_of(random_model(3, n_y=2, n_mv=2, n_dv=1, n_hidden=3), horizon=15, preview="course", operate={})
    export(law, path, case="made", provenance={})
    return Controller(path)
