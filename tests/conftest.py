"""How the tests run; their fixtures over PLANTS and LAWS are in quick_laws.py."""

from __future__ import annotations

import pytest
import scheduling
from scheduling import (  # noqa: F401  hooks of pytest
    pytest_collection_modifyitems,
    pytest_configure_node,
    pytest_xdist_make_scheduler,
)


def pytest_configure(config: pytest.Config) -> None:
    """Load the fixtures, and what they import, where tests run: the process that hands them out to others runs none."""
    scheduling.pytest_configure(config)
    if not scheduling.hands_out(config):
        config.pluginmanager.import_plugin("quick_laws")
