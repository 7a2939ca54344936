"""A small law that reads ``operate`` and ``fresh``, exported once a session.

Loaded by ``pytest_plugins``, not imported.
"""

from __future__ import annotations

from pathlib import Path

import pytest
from identified_models import random_model
from predictive_loops import law_of

from loopwright.pipeline.export.gate import export


@pytest.fixture(scope="session")
def operated_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two controlled variables, two MVs, one measured disturbance; a horizon that a test can wait for."""
    path = tmp_path_factory.mktemp("controller") / "operated.onnx"
    export(law_of(random_model(3, n_y=2, n_mv=2, n_dv=1), horizon=20, operate={}), path, case="made", provenance={})
    return path
