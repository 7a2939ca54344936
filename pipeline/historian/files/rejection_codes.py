"""Why a reading or a row is not used: one code each, and its words."""

from __future__ import annotations

from enum import IntEnum


class Reason(IntEnum):
    """Fault of a reading of a tag or of a row of the record; GOOD is none.

    A reading has the first reason that was found, in this order.
    """

    GOOD = 0
    EMPTY = 1
    TEXT = 2
    QUALITY = 3
    SENTINEL = 4
    RANGE = 5
    UNIT_SLIP = 6
    OUTLIER = 7
    DUPLICATE = 8
    CLOCK = 9
    GAP = 10
    STUCK = 11
    SATURATED = 12
    MODE = 13
    SHORT_RUN = 14
    COPY = 15
    UNLIKE = 16
    STOP = 17
    LEFT_OUT = 18

    @property
    def words(self) -> str:
        """The reason for a person."""
        return WORDS[self]


WORDS = {
    Reason.GOOD: "good",
    Reason.EMPTY: "empty cell",
    Reason.TEXT: "text where a number belongs",
    Reason.QUALITY: "quality is not good",
    Reason.SENTINEL: "code for a missing value",
    Reason.RANGE: "outside the range that was given",
    Reason.UNIT_SLIP: "another unit for a while",
    Reason.OUTLIER: "outlier",
    Reason.DUPLICATE: "a second reading of the same time",
    Reason.CLOCK: "time is ambiguous because the clock was set back",
    Reason.GAP: "no reading within the hold",
    Reason.STUCK: "sensor is stuck while others move",
    Reason.SATURATED: "sensor is at the end of its range",
    Reason.MODE: "mode that was asked to be left out",
    Reason.SHORT_RUN: "too short a piece between two gaps",
    Reason.COPY: "a block of earlier readings again",
    Reason.UNLIKE: "sensor and inputs contradict each other",
    Reason.STOP: "the plant stood still, or warmed up",
    Reason.LEFT_OUT: "a time that was asked to be left out",
}
