"""``loopwright verify``: who made a controller file; see ``serving.signing``."""

from serving.signing.command import run_verify as run
from serving.signing.command import verify_options as options

__all__ = ["options", "run"]
