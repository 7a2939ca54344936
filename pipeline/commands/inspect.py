"""``loopwright inspect``: a controller file and how its validation went."""

from __future__ import annotations

from loopwright.serving.__main__ import inspect_options as options
from loopwright.serving.__main__ import run_inspect as run

__all__ = ["options", "run"]
