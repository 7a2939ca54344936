"""``loopwright sign``: say who made a controller file; see ``loopwright.serving.signing``."""

from loopwright.serving.signing.command import run_sign as run
from loopwright.serving.signing.command import sign_options as options

__all__ = ["options", "run"]
