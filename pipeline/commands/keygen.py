"""``loopwright keygen``: a key to sign controller files with; see ``serving.signing``."""

from serving.signing.command import keygen_options as options
from serving.signing.command import run_keygen as run

__all__ = ["options", "run"]
