"""Quality of a reading, as historians write it: words, flags, OPC classic codes, OPC UA status codes."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

QUALITY = re.compile(
    r"^(?P<tag>.*?)[ ._:/-]*[(\[]?(?P<word>opcquality|quality|qualität|qualitaet|qualité|calidad|qual|"
    r"status ?code|status|stat|is ?_?good|is ?_?bad|is ?_?valid|good|bad|valid|invalid|questionable|substituted|"
    r"güte|(?<![^\W_])q)[)\]]?$",
    re.IGNORECASE,
)
GOOD = {
    "good", "ok", "g", "valid", "normal", "good, non-specific", "goodnonspecific", "gut", "gültig", "bon", "bonne",
    "bueno", "buena", "valide", "good (192)", "raw", "goodlocaloverride",
}  # fmt: skip
BAD = re.compile(
    r"^(bad|uncertain|b$|u$|invalid|questionable|substituted|error|fault|schlecht|ungültig|unsicher|mauvais|mal|not )"
)
NEGATIVE = re.compile(r"(bad|invalid|questionable|substituted)$", re.IGNORECASE)
POSITIVE = re.compile(r"(quality|qualität|qualitaet|qualité|calidad|qual|good|valid|güte|q)$", re.IGNORECASE)
HEX = re.compile(r"(?:0x|16#|&h|\[0x)([0-9a-f]{1,8})\]?$")
FIGURE = re.compile(r"^[+-]?\d+(\.0*)?$")
OPC_GOOD, OPC_CODES = 192, 64
"""OPC classic: bits 7 and 6 of the low byte both set are good; codes from 64 on tell it from plain flags."""
UA_CODES = 1 << 30
"""OPC UA: bits 31 and 30 are 00 for good, 01 for uncertain, 10 for bad."""
PERCENT, WHOLE_HEX = 100, 8


@dataclass(frozen=True, slots=True)
class Meaning:
    """Which texts of a quality's column say good; None where it says nothing of quality. ``says`` is the choice."""

    good: frozenset[str] | None
    says: str = ""


def meaning_of(column: str, counts: Mapping[str, int]) -> Meaning:
    """What the texts of one column, and how often each stands there, say of quality.

    Words: good, ok, valid and their like. Numbers from 2^30 on, and hexadecimal ones: OPC UA, of which 0 is good.
    Smaller ones from 64 on: OPC classic, of which 192 is good, or percent. Flags (0 and 1, true and false) mean what
    the column's name says, as IsBad; under another name the one that most rows have is good.
    """
    words = {t: t.strip().lower() for t in counts}
    good = {t for t, w in words.items() if w in GOOD or w.startswith("good")}
    bad = {t for t, w in words.items() if BAD.match(w)}
    truth = {
        t: w in {"true", "yes", "ja"} for t, w in words.items() if w in {"true", "false", "yes", "no", "ja", "nein"}
    }
    figures = {t: v for t, w in words.items() if (v := _figure(w)) is not None}
    if good and not figures:
        return Meaning(frozenset(good | {t for t, true in truth.items() if true}))
    if truth and not figures:
        return _flags(column, truth, counts)
    if figures:
        own, says = _of_figures(column, figures, counts)
        return Meaning(frozenset(own | good), says)
    empty = {t for t, w in words.items() if not w}
    if bad and empty and _times(empty, counts) > _times(bad, counts):
        return Meaning(frozenset(empty), "an empty cell is good")
    return Meaning(frozenset()) if bad else Meaning(None)


def _of_figures(column: str, figures: Mapping[str, int], counts: Mapping[str, int]) -> tuple[set[str], str]:
    values = {t: v & 0xFFFFFFFF for t, v in figures.items()}
    known = set(values.values())
    classic = {v for v in known if v < 1 << 16 and v & OPC_GOOD == OPC_GOOD}
    wide = any((m := HEX.search(t.strip().lower())) and len(m[1]) == WHOLE_HEX for t in figures)
    if max(known) >= UA_CODES or (wide and not classic):
        return {t for t, v in values.items() if v >> 30 == 0}, "OPC UA status codes, of which 0 is good"
    if max(known) == PERCENT and not classic:
        return {t for t, v in values.items() if v == PERCENT}, "percent, of which 100 is good"
    if max(known) >= OPC_CODES:
        return {t for t, v in values.items() if v & OPC_GOOD == OPC_GOOD}, ""
    if known <= {0, 1}:
        meaning = _flags(column, {t: v == 1 for t, v in values.items()}, counts, plain=True)
        return set(meaning.good or ()), meaning.says
    most = max(values, key=lambda t: counts[t])
    return {t for t, v in values.items() if v == values[most]}, f"{most} is good, as in most rows"


def _flags(column: str, truth: Mapping[str, bool], counts: Mapping[str, int], *, plain: bool = False) -> Meaning:
    """The flags that say good. 0 and 1 (``plain``) under the name quality may be either: OPC UA has 0 for good."""
    name = column.strip(" )]").replace("_", " ")
    true, false = ({t for t, v in truth.items() if v is way} for way in (True, False))
    if NEGATIVE.search(name):
        return Meaning(frozenset(false), _shown(false, "because of the column's name"))
    certain = re.search(r"(good|valid)$", name, re.IGNORECASE) if plain else POSITIVE.search(name)
    if certain:
        return Meaning(frozenset(true), _shown(true, "because of the column's name") if plain else "")
    most = true if _times(true, counts) > _times(false, counts) else false
    return Meaning(frozenset(most), _shown(most, "as in most rows"))


def _shown(texts: set[str], why: str) -> str:
    return f"{' and '.join(sorted(texts)) or 'the other flag'} is good, {why}"


def _times(texts: set[str], counts: Mapping[str, int]) -> int:
    return sum(counts[t] for t in texts)


def _figure(text: str) -> int | None:
    """The number of a code, decimal or hexadecimal; None where the text is none."""
    if FIGURE.match(text):
        return int(float(text))
    match = HEX.match(text)
    return int(match[1], 16) if match else None


def is_quality(word: str, texts: Sequence[str], *, beside: bool) -> bool:
    """Whether a column named by ``word``, such as quality or status, holds qualities, by some of its cells.

    Any flag or code will do under a certain name, or ``beside`` a tag of that name. A status or q by itself needs words
    of quality or codes of OPC: it may be the state of the plant, or a tag.
    """
    known = {t.strip().lower() for t in texts if t.strip()}
    figures = {v for w in known if (v := _figure(w)) is not None}
    flags = {"true", "false", "yes", "no", "ja", "nein"}
    words = {w for w in known if w in GOOD or w.startswith("good") or BAD.match(w)}
    if not all(w in words or w in flags or _figure(w) is not None for w in known):
        return bool(words)
    sure = beside or bool(NEGATIVE.search(word) or POSITIVE.search(word))
    return (sure and word.lower() != "q") or bool(words) or any(v >= OPC_GOOD for v in figures)
