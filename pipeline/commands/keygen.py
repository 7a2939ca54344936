"""``loopwright keygen``: a key to sign controller files with; see ``loopwright.serving.signing``."""

from loopwright.serving.signing.command import keygen_options as options
from loopwright.serving.signing.command import run_keygen as run

__all__ = ["options", "run"]
