"""Errors of loading, stepping and running a controller.

LoopwrightError
+-- ArtifactError      the file is not a controller: corrupt, truncated, foreign, changed after export
|   +-- SignatureError the file is unsigned, signed by a foreign key, changed since, or its signature expired
+-- ContractError      an input has the wrong name, shape or type
+-- SampleError        a value is not finite, so no manipulated variable may be computed from it
+-- OutputError        the law gave a value that is not finite, outside its signal's range, or too far from the last one
+-- LoopError          the loop was asked for something that its configuration does not allow
    +-- NotProvenError AUTO is asked for a controller that is not proven, and nobody gave a word for it
    +-- EndpointError  the plant's side (server, device) cannot be read or written
"""

from __future__ import annotations


class LoopwrightError(Exception):
    """Base of every error that Loopwright raises on purpose; its text is one line for a person.

    ``entry`` names the entry of ``operate`` that is wrong, or of a course the signal and the place of its point, as
    TIC-1.2; empty where it is none.
    """

    entry = ""


class ArtifactError(LoopwrightError):
    """The file is not a controller that this runtime accepts."""


class SignatureError(ArtifactError):
    """The file has no valid signature of a trusted key, or a key or a signature cannot be used."""


class ContractError(LoopwrightError):
    """An input does not match the controller's manifest."""


class SampleError(LoopwrightError):
    """A sample holds a value that is not finite."""


class OutputError(LoopwrightError):
    """The law's output is not finite, lies outside its signal's range, or moves by more than its signal may."""


class LoopError(LoopwrightError):
    """The control loop was configured or used in a way that is not allowed."""


class NotProvenError(LoopError):
    """A controller that its file does not prove is to write in AUTO, and nobody accepted it; ``why`` it is not."""

    def __init__(self, words: str, why: str) -> None:
        super().__init__(words)
        self.why = why


class EndpointError(LoopError):
    """The endpoint that stands for the plant cannot be read or written."""
