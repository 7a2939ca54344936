"""Test vectors of a controller file for a host in any language, and the check of a host's answers."""

from __future__ import annotations

from loopwright.serving.__main__ import conformance_options as options
from loopwright.serving.__main__ import run_conformance as run

__all__ = ["options", "run"]
