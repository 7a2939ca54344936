"""``loopwright sign``: say who made a controller file; see ``serving.signing``."""

from serving.signing.command import run_sign as run
from serving.signing.command import sign_options as options

__all__ = ["options", "run"]
