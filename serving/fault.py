"""Faults as values: what is wrong, and with what, beside the words that say it."""

from __future__ import annotations

import re

NUMBER = re.compile(r"(?<![\w.-])[-+]?\d+(?:\.\d+)?(?:e[-+]?\d+)?(?!\w)")


class Fault(str):
    """Why a sample or an MV is not used: a line for a person, which is what it is as a text.

    Two faults of one ``kind`` and ``subject`` are the same fault, whatever numbers their lines hold. A plain text is a
    fault too, as the plants and guards of users give it.

    Parameters
    ----------
    words
        The line.
    kind
        What is wrong: "range", "age", "quality".
    subject
        What it is wrong with: "PV T"; empty where there is but one.
    lasting
        The line that stays true while the fault lasts; ``words`` unless given.
    """

    kind: str
    subject: str
    lasting: str

    def __new__(cls, words: str, kind: str, subject: str = "", lasting: str = "") -> Fault:
        """A line that knows which fault it tells."""
        found = super().__new__(cls, words)
        found.kind, found.subject, found.lasting = kind, subject, lasting or words
        return found

    def __getnewargs__(self) -> tuple[str, str, str, str]:  # type: ignore[override]  # copied and pickled as it is
        return str(self), self.kind, self.subject, self.lasting


def reworded(fault: str, words: str) -> str:
    """The same fault in other words, which are of now: they hold for as long as it lasts."""
    return Fault(words, fault.kind, fault.subject) if isinstance(fault, Fault) else words


def told_by(error: Exception, words: str) -> str:
    """The ``words`` of an error; a fault where the error carries one."""
    carried = error.args[0] if error.args else ""
    return reworded(carried, words) if isinstance(carried, str) else words


def kind_of(fault: str) -> tuple[str, ...]:
    """The key by which two faults are the same one.

    For a plain text it is the text without the numbers that stand alone: those of a name, as in T-101, belong to it.
    """
    return (fault.kind, fault.subject) if isinstance(fault, Fault) else (NUMBER.sub("#", fault),)


def lasting(fault: str) -> str:
    """A fault's words for as long as it lasts: an age grows meanwhile."""
    return fault.lasting if isinstance(fault, Fault) else fault
