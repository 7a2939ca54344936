"""How long a step takes on this machine."""

from __future__ import annotations

from loopwright.serving.__main__ import bench_options as options
from loopwright.serving.__main__ import run_bench as run

__all__ = ["options", "run"]
