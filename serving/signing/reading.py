"""Files of somebody else's, read with a limit."""

from __future__ import annotations

import os
import stat
from pathlib import Path

from loopwright.serving.controller_file import without_waiting
from loopwright.serving.errors import SignatureError


def contents(path: Path, most: int) -> bytes:
    """The bytes of a regular file of at most ``most`` bytes; FileNotFoundError where there is none.

    Raises SignatureError for anything else: a pipe would be waited for, and a device may never end.
    """
    try:
        with open(path, "rb", opener=without_waiting) as file:
            if not stat.S_ISREG(os.fstat(file.fileno()).st_mode):
                raise SignatureError(f"{path} is no regular file")
            data = file.read(most + 1)
    except FileNotFoundError:
        raise
    except (OSError, ValueError) as error:  # ValueError: a path with a NUL in it
        raise SignatureError(f"{path} cannot be read: {getattr(error, 'strerror', None) or error}") from None
    if len(data) > most:
        raise SignatureError(f"{path} has more than the {most} bytes that it may have")
    return data
