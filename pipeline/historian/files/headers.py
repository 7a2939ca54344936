"""The header of an export: a tag and its unit in brackets; the unit of time in the header of the times."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

SQUARE = re.compile(r"^(?P<name>.*\S)\s*\[(?P<unit>[^\[\]]*)\]$")  # the last bracket: TIC[1].PV [degC]
ROUND = re.compile(r"^(?P<name>.*\S)\s*\((?P<unit>[^()]{1,16})\)$")
# A unit in round brackets, which may hold any words: these, with prefixes and powers, their products and quotients.
BASES = (
    "%|°|°C|°F|degC|degF|deg|grd|K|C|F|m|g|t|l|L|s|sec|h|hr|min|d|bar|barg|bara|Pa|psi|psig|A|V|W|VA|var|Wh|J|Hz|N|Nm|"
    "mol|M|pH|ppm|ppb|rpm|lb|ft|in|gal|gpm|bbl|BTU|S|cP|Ω|Nm3|Sm3|m3|vol|vol%|wt%|pct"
)
ONE = rf"[kmµuMGcdh]?(?:{BASES})(?:[²³0-9]|\^-?[0-9])?"
UNIT = re.compile(rf"^{ONE}(?:[/*·.\s]?{ONE})*$")
TEMPERATURES = {"C", "F", "K"}  # letters that are units behind the name of a temperature, as of TI-7 or Outlet.Temp
OF_TEMPERATURE = re.compile(r"temp|(?:^|[^a-z])t[iatcrjxe]{0,4}(?:[-_ ]?\d|_|$)", re.IGNORECASE)
LETTERED = re.compile(r"^(?P<name>.*\S)\s*\((?P<letter>[A-Z])\)$")  # T1 (A), one of several

SPELLINGS = {
    "ns": (1e-9, "ns nsec nanosecond nanoseconds nanosekunde nanosekunden"),
    "us": (1e-6, "us usec µs μs microsecond microseconds mikrosekunde mikrosekunden"),
    "ms": (1e-3, "ms msec msecs millis millisecond milliseconds millisekunde millisekunden"),
    "s": (1.0, "s sec secs second seconds sek sekunde sekunden seconde secondes segundo segundos secondi"),
    "min": (60.0, "min mins minute minutes minuten minuto minutos minuti mn"),
    "h": (3600.0, "h hr hrs hour hours std stunde stunden heure heures hora horas ore"),
    "d": (86_400.0, "d day days tag tage jour jours día días dia dias giorni"),
    "weeks": (604_800.0, "w wk wks week weeks woche wochen"),
}
TIME_UNITS = {word: factor for factor, words in SPELLINGS.values() for word in words.split()}  # to seconds
# Words that mean another thing behind a name, as in Time Tag, TS_STD or Fecha hora; in brackets they are units.
IN_BRACKETS = {"tag", "std", "w", "wk", "ore", "dia", "día", "hora", "heure", "jour"}
AFTER_ZEIT = {"tag", "std"}
GERMAN = {"zeit", "laufzeit"}
AMONG_WORDS = {w for w in TIME_UNITS if len(w) > 1} - IN_BRACKETS - {"us"}
ALONE = {word for word in TIME_UNITS if len(word) > 3 or word == "sec"} - {"days", "tage"}  # a header by itself
NO_UNITS = {"", "utc", "gmt", "z", "local", "local time", "lokal", "epoch", "unix", "posix", "unix time", "-"}

NAMES = {
    "time_s", "time", "timestamp", "datetime", "date", "date time", "date/time", "datetimeutc", "ts", "t", "zeit",
    "zeitstempel", "datum", "time stamp", "utc", "epoch", "index",
}  # fmt: skip
FIRST_WORDS = {
    "time", "times", "timestamp", "timestamps", "datetime", "date", "ts", "t", "zeit", "zeitstempel", "zeitpunkt",
    "datum", "utc", "epoch", "unix", "posix", "elapsed", "uhrzeit", "laufzeit", "tiempo", "fecha", "temps",
    "horodatage", "tempo", "hora", "heure",
}  # fmt: skip
LAST_WORDS = {"time", "timestamp", "datetime", "zeit", "zeitstempel", "seconds", "elapsed"}
VAGUE = {"t", "index", "tempo", "temps", "hora", "heure"}  # may be a temperature, or the number of a row
DATES = {"date", "datum", "datetime", "timestamp", "fecha", "zeitstempel", "horodatage", "zeitpunkt"}
BRACKET = re.compile(r"^(?P<name>.*?)\s*[\[({]\s*(?P<unit>[^\[\](){}]*?)\s*[\])}]\s*$")
INNER = re.compile(r"[\[({<]\s*(?P<unit>[^\W\d_]+)\.?\s*[\])}>]")  # of Time (min) since start
TAIL = re.compile(r"^(?P<name>.*?)(?:\s*[_\s./,:-]\s*|\s+in\s+)(?P<unit>[^\W\d_]+)\.?$")


@dataclass(frozen=True, slots=True)
class TimeHeader:
    """A header read as that of a column of times."""

    factor: float | None  # unit of its numbers to seconds; None where no unit is written
    unknown: str  # what brackets hold that is no unit of time
    rank: int  # 0 the exact name of a time, 1 begins with its word, 2 ends with it or may be another thing, 3 no time
    date: bool  # the name is one of dates

    @property
    def named(self) -> bool:
        """Whether the name is one of times."""
        return self.rank < 3


def split_header(column: str) -> tuple[str, str]:
    """(tag, unit) of a header: of ``TIC-7.PV [degC]``, ``TIC-7.PV (°C)``; the unit is empty where none is written.

    The last square bracket holds the unit, unless it is a number, as of ``TIC[1]``. Round brackets hold one only
    where they look like one: ``FI-7 (raw)`` is a tag, and ``P-7 (A)`` a pump; ``TI-7 (C)`` is in degrees Celsius.
    """
    column = " ".join(column.split())
    square = SQUARE.match(column)
    if square is not None:
        unit = square["unit"].strip()
        return (column, "") if unit.isdecimal() else (square["name"], unit)
    match = ROUND.match(column)
    found = match["unit"].strip() if match else ""
    letter = len(found) == 1 and found.isupper()
    if letter and match is not None and found in TEMPERATURES and OF_TEMPERATURE.search(match["name"]):
        letter = False
    if match is None or not UNIT.match(found) or letter:
        return column, ""
    return match["name"], found


def tags_of(header: Sequence[str]) -> dict[str, str]:
    """Column -> its tag without the unit; the whole header where two columns differ in their brackets only."""
    own = {column: split_header(column)[0] for column in header}
    lettered = [match for column in header if (match := LETTERED.match(" ".join(column.split())))]
    several = {match["name"] for match in lettered if match["letter"] not in TEMPERATURES}
    own |= {column: column for column, tag in own.items() if tag in several}  # T1 (C) beside T1 (A) is no temperature
    times = Counter(own.values())
    return {column: tag if times[tag] == 1 else column for column, tag in own.items()}


def tag_named(text: str, columns: Mapping[str, str]) -> str:
    """The tag that a person means by a tag, a header, or a header with a unit, of columns and their tags."""
    if text in columns.values():
        return text
    return columns.get(text) or split_header(text)[0]


def time_header(column: str) -> TimeHeader:
    """The header as one of times: ``Time (min)``, ``elapsed [hr]``, ``t_ms``, ``Zeit s``, ``TIME/H``, ``minutes``."""
    text = " ".join(column.split())
    whole = text.lower()
    factor, unknown, name = None, "", text
    if (match := BRACKET.match(text)) is not None:
        inner = match["unit"].lower().rstrip(".")
        name, factor = match["name"], TIME_UNITS.get(inner, TIME_UNITS.get(inner.partition(" ")[0]))  # s since start
        factor = _among(_words(inner)) if factor is None and not re.search(r"\d", inner) else factor
        unknown = "" if factor is not None or inner in NO_UNITS else match["unit"]
    words = _words(name)
    if factor is None and not unknown:
        parts = TAIL.match(re.sub(r"(?<=[a-z])(?=[A-Z])", "_", name))
        if parts is not None and _is_unit_behind(parts["name"], parts["unit"]):
            name, factor = parts["name"], TIME_UNITS[parts["unit"].lower()]
        elif name.lower() in ALONE:
            return TimeHeader(TIME_UNITS[name.lower()], unknown, 2, date=False)
        elif units := {TIME_UNITS[w] for u in INNER.findall(name) if (w := u.lower()) in TIME_UNITS}:
            factor = units.pop() if len(units) == 1 else None
        elif len(words) > 1:
            factor = _among(words)
        words = _words(name)
    lower = name.strip().lower()
    vague = lower in VAGUE
    if (lower in NAMES or whole in NAMES) and not vague:
        rank = 0
    elif words and words[0] in FIRST_WORDS and not vague and words[0] not in VAGUE:
        rank = 1
    elif lower in VAGUE or (words and (words[0] in VAGUE - {"index"} or words[-1] in LAST_WORDS)):
        rank = 2
    else:
        rank = 3
    return TimeHeader(factor, unknown, rank, bool(words) and bool({words[0], words[-1]} & DATES))


def _words(name: str) -> list[str]:
    return [w for w in re.split(r"[\W_\d]+", re.sub(r"(?<=[a-z])(?=[A-Z])", "_", name).lower()) if w]


def _is_unit_behind(name: str, word: str) -> bool:
    """Whether the last word of a header is a unit of time."""
    word = word.lower()
    known = word not in IN_BRACKETS or (word in AFTER_ZEIT and name.strip(" _./,:-").lower() in GERMAN)
    return word in TIME_UNITS and known


def _among(words: Sequence[str]) -> float | None:
    """The unit that stands among several words, as in Minutes elapsed; None for none or several."""
    found = {TIME_UNITS[w] for w in words if w in AMONG_WORDS}
    return found.pop() if len(found) == 1 else None
