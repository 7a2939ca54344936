"""``loopwright verify``: who made a controller file; see ``loopwright.serving.signing``."""

from loopwright.serving.signing.command import run_verify as run
from loopwright.serving.signing.command import verify_options as options

__all__ = ["options", "run"]
