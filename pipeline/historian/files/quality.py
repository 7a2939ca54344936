"""Quality of a reading as historians write it, and why a reading or a row is not used."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from enum import IntEnum

# Names that a column may have by itself; the quality of every tag in its row then.
ALONE = (
    r"opcquality|quality|qualität|qualitaet|qualité|calidad|qual|status ?code|status|stat|is ?_?good|is ?_?bad|"
    r"is ?_?valid|good|bad|valid|invalid|questionable|substituted|güte|(?<![^\W_])q"
)
# Names that say quality beside a tag, or in a table with a row a reading. By themselves they may be a plant's state.
BESIDE = (
    r"(?:%|percent|pct)[ _]?good|quality ?detail|data ?integrity|validity|confidence|(?:is ?_?)?uncertain|"
    r"(?<![^\W_])(?:conf|(?:is ?_?)?ok|fault)"
)
QUALITY = re.compile(rf"^(?P<tag>.*?)[ ._:/-]*[(\[]?(?:(?P<word>{ALONE})|(?P<beside>{BESIDE}))[)\]]?$", re.IGNORECASE)
GOOD = {
    "good", "ok", "g", "valid", "normal", "good, non-specific", "goodnonspecific", "gut", "gültig", "bon", "bonne",
    "bueno", "buena", "valide", "good (192)", "raw", "goodlocaloverride",
}  # fmt: skip
BAD = re.compile(
    r"^(bad|uncertain|b$|u$|invalid|questionable|substituted|error|fault|schlecht|ungültig|unsicher|mauvais|mal|not )"
)
TRUE = {"true", "yes", "ja", "wahr", "vrai", "oui", "si", "sí", "sì", "verdadero", "vero", "y", "t"}
FALSE = {"false", "no", "nein", "falsch", "faux", "non", "falso", "n", "f"}
MARK = re.compile(r"^(\W*|x)$")  # an empty cell, - or *
NEGATIVE = re.compile(r"(bad|invalid|questionable|substituted|uncertain|fault)$", re.IGNORECASE)
POSITIVE = re.compile(
    r"(quality|qualität|qualitaet|qualité|calidad|qual|good|valid|güte|q|detail|integrity|validity|conf|confidence|ok)$",
    re.IGNORECASE,
)
GOOD_BY_NAME = re.compile(r"(good|valid|validity|ok)$", re.IGNORECASE)  # 1 is good, whoever writes it
HEX = re.compile(r"(?:0x|16#|&h|\[0x)([0-9a-f]{1,8})\]?$")
BARE_HEX = re.compile(r"^([0-9a-f]{2}|[0-9a-f]{8})$")  # where all cells of a column are such
FIGURE = re.compile(r"^[+-]?\d+(\.0*)?$")
OPC_GOOD, OPC_CODES = 192, 64
"""OPC classic: bits 7 and 6 of the low byte both set are good; codes from 64 on tell it from plain flags."""
CLASSIC = {0, 4, 8, 12, 16, 20, 24, 28, 32, 64, 68, 80, 84, 88, 192, 216}
"""OPC classic: the codes that are defined, without the bits of limits and of the vendor."""
UA_CODES = 1 << 30
"""OPC UA: bits 31 and 30 are 00 for good, 01 for uncertain, 10 for bad."""
WHOLE_SHARE, WHOLE_HEX = 100, 8  # [%] of a quality that is good, and digits of a whole status code
# of the rows have what is good, where nothing but its number tells it; a state of the plant has less
MOSTLY_GOOD = 0.75
MOST_QUALITIES = 1_000  # more are the values of a tag
MOST_STATE_NUMBERS = 20  # numbers of a column of states; more are readings
UNUSED = "does not tell which of its values is good, and is not used"


@dataclass(frozen=True, slots=True)
class Meaning:
    """The texts of a quality's column that say good; None where it says nothing of quality. ``says`` is the choice."""

    good: frozenset[str] | None
    says: str = ""


def is_quality_name(column: str) -> bool:
    """Whether a header is a word of quality and nothing else."""
    match = QUALITY.match(column)
    return match is not None and not match["tag"]


def is_sure(column: str) -> bool:
    """Whether a header by itself names a quality, and not a state, as Status, or a flow, as Q."""
    match = QUALITY.match(column)
    if match is None or match["tag"] or not match["word"] or match["word"].lower() == "q":
        return False
    return bool(NEGATIVE.search(match["word"]) or POSITIVE.search(match["word"]))


def names_a_state(column: str) -> bool:
    """Whether a header names the status of something, as Pump Status, and not of a reading."""
    match = QUALITY.match(column)
    return match is not None and bool(match["tag"]) and (match["word"] or "").lower() in {"status", "stat"}


def meaning_of(column: str, counts: Mapping[str, int]) -> Meaning:
    """The quality that the texts of one column, and how often each stands there, mean.

    Words: good, ok, valid and their like. Numbers from 2^30 on, and hexadecimal ones: OPC UA, of which 0 is good.
    Smaller ones from 64 on: OPC classic, of which 192 is good, or percent. Flags (0 and 1, true and false) mean what
    the column's name says, as IsBad. Where neither tells it, the text that most rows have is good.
    """
    words = {t: t.strip().lower() for t in counts}
    good = {t for t, w in words.items() if w in GOOD or w.startswith("good")}
    bad = {t for t, w in words.items() if BAD.match(w)}
    truth = {t: w in TRUE for t, w in words.items() if w in TRUE or w in FALSE}
    if bad and truth and not any(truth.values()):  # n beside bad is normal
        good, truth = good | set(truth), {}
    figures = _figures(words)
    if good and not figures:
        return Meaning(frozenset(good | {t for t, true in truth.items() if true}))
    if truth and not figures:
        return _flags(column, truth, counts)
    if figures:
        own, says = _of_figures(column, figures, counts)
        return Meaning(None, says) if own is None else Meaning(frozenset(own | good), says)
    others = {t for t in words if t not in bad and counts[t]}
    if bad and others:
        shown = ", ".join(sorted(t.strip() or "an empty cell" for t in others)[:3])
        return Meaning(frozenset(others), f"{shown} is good, because no word for it stands beside {min(bad)}")
    if not bad and others and all(MARK.match(words[t]) for t in others):
        most = max(others, key=lambda t: counts[t])
        if counts[most] >= MOSTLY_GOOD * sum(counts.values()):
            return Meaning(frozenset({most}), f"{most.strip() or 'an empty cell'} is good, as in most rows")
    return Meaning(frozenset()) if bad else Meaning(None, UNUSED)


def _of_figures(column: str, figures: Mapping[str, int], counts: Mapping[str, int]) -> tuple[set[str] | None, str]:
    values = {t: v & 0xFFFFFFFF for t, v in figures.items()}
    known, total = set(values.values()), _times(set(figures), counts)
    classic = {t for t, v in values.items() if v < 1 << 16 and v & OPC_GOOD == OPC_GOOD}
    wide = any((m := HEX.search(t.strip().lower())) and len(m[1]) == WHOLE_HEX for t in figures)
    if max(known) >= UA_CODES or (wide and not classic):
        return {t for t, v in values.items() if v >> 30 == 0}, "OPC UA status codes, of which 0 is good"
    whole = {t for t, v in values.items() if v == WHOLE_SHARE}
    if max(known) == WHOLE_SHARE and (known <= {0, WHOLE_SHARE} or 2 * _times(whole, counts) > total):
        return whole, "percent, of which 100 is good"
    if classic and (_are_codes(known) or _times(classic, counts) >= MOSTLY_GOOD * total):
        return classic, ""
    if known <= {0, 1}:
        meaning = _flags(column, {t: v == 1 for t, v in values.items()}, counts, plain=True)
        return None if meaning.good is None else set(meaning.good), meaning.says
    most = max(values, key=lambda t: counts[t])
    same = {t for t, v in values.items() if v == values[most]}
    if _times(same, counts) < MOSTLY_GOOD * total:
        return None, UNUSED
    return same, f"{most} is good, as in most rows"


def _are_codes(known: set[int], *, bare: bool = False) -> bool:
    """Whether all figures are codes of OPC; ``bare`` are classic ones without the bits of limits and of the vendor."""
    if max(known, default=0) >= UA_CODES:
        return True
    return all((v if bare else v & 0xFC) in CLASSIC for v in known) and max(known, default=0) < 1 << 16


def _flags(column: str, truth: Mapping[str, bool], counts: Mapping[str, int], *, plain: bool = False) -> Meaning:
    """The flags that say good. 0 and 1 (``plain``) under the name quality may be either: OPC UA has 0 for good."""
    name = column.strip(" )]").replace("_", " ")
    true, false = ({t for t, v in truth.items() if v is way} for way in (True, False))
    if NEGATIVE.search(name):
        return Meaning(frozenset(false), _shown(false, "because of the column's name"))
    if (GOOD_BY_NAME if plain else POSITIVE).search(name):
        return Meaning(frozenset(true), _shown(true, "because of the column's name") if plain else "")
    most = true if _times(true, counts) > _times(false, counts) else false
    if _times(most, counts) < MOSTLY_GOOD * (_times(true, counts) + _times(false, counts)):
        return Meaning(None, UNUSED)
    return Meaning(frozenset(most), _shown(most, "as in most rows"))


def _shown(texts: set[str], why: str) -> str:
    return f"{' and '.join(sorted(texts)) or 'the other flag'} is good, {why}"


def _times(texts: set[str], counts: Mapping[str, int]) -> int:
    return sum(counts[t] for t in texts)


def _figures(words: Mapping[str, str]) -> dict[str, int]:
    """Text -> the number of a code, decimal or hexadecimal, of those that are one."""
    filled = [w for w in words.values() if w]
    if filled and all(map(BARE_HEX.match, filled)):
        together = "".join(filled)
        if re.search(r"\d", together) and re.search(r"[a-f]", together):
            return {t: int(w, 16) for t, w in words.items() if w}
    found = {}
    for text, word in words.items():
        if FIGURE.match(word):
            found[text] = int(float(word))
        elif match := HEX.match(word):
            found[text] = int(match[1], 16)
    return found


def is_quality(column: str, counts: Mapping[str, int], *, beside: bool) -> bool:
    """Whether a column with a name of quality holds qualities, by its texts and how often each stands there.

    ``beside`` a tag, or in a row that is one reading, any flag or code will do. By itself it may be a tag, or the state
    of the plant: there numbers are flags under a certain name, or codes of OPC; texts hold words of quality.
    """
    match = QUALITY.match(column)
    if match is None or len(counts) > MOST_QUALITIES or not (match["word"] or beside):
        return False
    words = {t: w for t in counts if (w := t.strip().lower())}
    word = (match["word"] or match["beside"]).lower()
    figures = _figures(words)
    good = any(w in GOOD or w.startswith("good") for w in words.values())
    bad = any(BAD.match(w) for w in words.values())
    texts = [w for t, w in words.items() if t not in figures]
    if not all(w in GOOD or w.startswith("good") or BAD.match(w) or w in TRUE | FALSE or MARK.match(w) for w in texts):
        return good or (beside and bad)
    if good or bad:
        return True
    values = {t: v & 0xFFFFFFFF for t, v in figures.items()}
    known, total = set(values.values()), sum(counts.values())
    usual = _times({t for t, v in values.items() if v in {192, 216}}, counts)
    if (word != "q" and usual and usual >= MOSTLY_GOOD * total) or (
        _are_codes(known, bare=True) and any(v >= OPC_GOOD for v in known)
    ):
        return True
    if not beside:
        return is_sure(column) and known <= {0, 1, WHOLE_SHARE}
    return word != "q" and len(known) <= MOST_STATE_NUMBERS and meaning_of(column, counts).good is not None


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
