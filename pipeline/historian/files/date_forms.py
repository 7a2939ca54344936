"""Forms of dates that are not ISO-8601: day and month told apart, months by name, AM and PM; counts of days."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from datetime import datetime

import numpy as np

from loopwright.pipeline.errors import RecordError
from loopwright.pipeline.metrics import Array

# ------------------------------------ counts of days, as 45355.25 of a spreadsheet, told from seconds since some start
DAY_S = 86_400.0  # [s] of a day


@dataclass(frozen=True, slots=True)
class Days:
    """A count of days: which numbers are such, and where it has 1970."""

    words: str
    low: float
    high: float
    at_1970: float


# Numbers of a spreadsheet are days since 1899-12-30: these are years 1968 to 2077. With the other origin of some old
# workbooks, 1904, the same numbers are four years later; they cannot be told apart, and the steps are the same.
SERIAL = Days("dates of a spreadsheet, in days since 1899-12-30", 25_000.0, 65_000.0, 25_569.0)
DAYS = (
    SERIAL,
    Days("dates of MATLAB, in days since the year 0", 700_000.0, 770_000.0, 719_529.0),
    Days("Julian dates, in days", 2.43e6, 2.49e6, 2_440_587.5),
)
YEAR = 365.25  # days
FIRST_YEAR, LAST_YEAR = 1990, 2050  # of a record, where no name says that numbers are dates
LONGEST = 30 * YEAR  # of a record
SHORTEST_STEP = 2e-3  # shorter steps are of days: no plant is sampled every 2 ms, and many every 3 minutes
USUAL_S = (*(60.0 * n for n in (3, 4, 5, 6, 10, 12, 15, 20, 30)), *(3600.0 * n for n in (1, 2, 3, 4, 6, 8, 12, 24)))
GRIDS_S = (1.0, 60.0, 300.0, 600.0, 900.0, 1800.0, 3600.0, 7200.0)  # that dates of a plant's readings stand on
EQUAL_STEPS = 0.9  # of the steps are equal
DISTINCT_TIMES = 10  # times of the day, for a grid that is no chance
SHORT_DIGITS = 4  # a sampling period in seconds has no more


class UnclearCountError(RecordError):
    """Numbers that may be seconds or a count of days."""


def days_of(values: Array, *, dated: bool, counter: bool = False, everywhere: bool = False) -> Days | None:
    """The count of days that numbers (n,) are; None where they are seconds or another unit.

    ``dated`` is a header that says date, ``counter`` one that may number the rows. Other numbers are days if they stand
    on whole seconds, minutes or hours of the day, and their digits are none of a sampling period in seconds. Numbers
    ``everywhere`` come from all over a column, so that their steps say nothing. UnclearCountError where both may be.
    """
    own = next((d for d in DAYS if np.all((values > d.low) & (values < d.high))), None)
    if own is None or dated:
        return own
    years = 1970 + (values - own.at_1970) / YEAR
    if years.min() < FIRST_YEAR or years.max() > LAST_YEAR or np.ptp(values) > LONGEST:
        return None
    steps = np.abs(np.diff(values))
    stands = np.count_nonzero(steps == 0) > (1 - EQUAL_STEPS) * len(steps)  # digits are missing
    steps = steps[steps > 0]
    step, whole = (float(np.median(steps)) if steps.size else 0.0), not np.any(values % 1)
    if everywhere:
        raise UnclearCountError(f"{values[0]:.10g}")
    if not whole and step < SHORTEST_STEP:
        return own
    if step > 1 or (whole and (step < 1 or counter)):
        return None
    unit = _last_digit(values)
    if not stands and _is_regular_and_odd(steps, step, unit):
        return None
    if not whole and _on_grid(values, unit):
        return own
    raise UnclearCountError(f"{values[0]:.10g}")


def _last_digit(values: Array) -> float:
    """The unit of the last digit that some of the numbers have, 1e-9 for all finer ones."""
    for digits in range(9):
        scaled = values * 10.0**digits
        if np.all(np.abs(scaled - np.round(scaled)) < 0.02):
            return float(10.0**-digits)
    return 1e-9


def _is_regular_and_odd(steps: Array, step: float, unit: float) -> bool:
    """Whether the steps are equal, and of no period that readings of a plant come in, taken as days."""
    equal = steps[np.abs(steps - step) <= 1.01 * unit]
    if len(equal) < EQUAL_STEPS * len(steps):
        return False
    period_s = DAY_S * float(np.mean(equal))
    error_s = DAY_S * unit * (1 + len(steps) - len(equal)) / len(equal) + 1e-6 * period_s
    return all(abs(period_s - usual) > error_s for usual in USUAL_S)


def _on_grid(values: Array, unit: float) -> bool:
    """Whether all numbers are whole seconds, minutes or hours of the day, as no numbers of few digits are."""
    if len(np.unique(np.round(values % 1, 9))) < DISTINCT_TIMES:
        return False
    short = np.abs(values * 10.0**SHORT_DIGITS - np.round(values * 10.0**SHORT_DIGITS)) < 1e-4
    for grid_s in GRIDS_S:
        grid = grid_s / DAY_S
        beside = np.abs(values / grid - np.round(values / grid)) * grid
        exact = short & (beside < 0.01 * unit + 2e-11)
        if 4 * unit <= grid and np.all(beside <= 0.505 * unit + 2e-11) and 2 * np.count_nonzero(exact) <= len(values):
            return True
    return False


# ------------------------------------------------------------------------------------------------------ dates as texts
DATE = re.compile(r"^(?P<a>\d{1,4})(?P<sign>[./\- ])(?P<b>\d{1,2})(?P=sign)(?P<c>\d{4}|\d{1,2})(?P<rest>(?:\D.*)?)$")
COMPACT = re.compile(
    r"^(?P<date>\d{8})(?P<sign>[T _-]?)(?P<clock>\d{6}|\d{4}|\d{2}:\d\d(?::\d\d)?)?(?P<rest>[.,]?\d*Z?)$"
)
REST = re.compile(
    r"^(?P<gap>[T ,;]*\s*)(?P<clock>\d{6}|\d{1,2}(?P<sign>[:.])\d\d(?:(?P=sign)\d\d)?)(?P<part>[.,:]\d+)?"
    r"\s*(?P<half>[AaPp][Mm])?\s*(?P<zone>Z|[+-]\d\d:?\d\d)?$"
)
HOUR = re.compile(r"^\d{1,2}:\d\d(:\d\d([.,]\d+)?)?( ?[AaPp][Mm])?$")
HOUR_DIGITS = re.compile(r"^([01]?\d|2[0-3])[0-5]\d[0-5]\d$")  # 060054, or 60054 where a program dropped the zero
ELAPSED = re.compile(r"^\d{1,5}:\d\d:\d\d([.,]\d+)?( ?[AaPp][Mm])?$")
MIDNIGHT = re.compile(r"(?<!\d)24(?=[:.]00(?:[:.]00(?:[.,]0+)?)?(?!\d))")  # the end of a day
MONTHS = (
    "jan januar january janvier enero ene gennaio gen januari janeiro",
    "feb februar february février fevrier fév febrero febbraio fev februari fevereiro",
    "mar mär mrz märz march mars marzo mrt maart março marco", "apr april avril avr abril abr aprile",
    "may mai mayo maggio mag mei maj maio", "jun juni june juin junio giugno giu junho",
    "jul juli july juillet juil julio luglio lug julho", "aug august août aout agosto ago augustus",
    "sep sept september septembre septiembre settembre set setembro",
    "oct okt oktober october octobre octubre ottobre ott out outubro",
    "nov november novembre noviembre novembro",
    "dec dez dezember december décembre déc diciembre dic dicembre des dezembro",
)  # fmt: skip
MONTH = {word: number for number, words in enumerate(MONTHS, 1) for word in words.split()}
WORD = re.compile(r"[^\W\d_]{3,9}\.?")
WEEKDAY = re.compile(r"^[^\W\d_]{2,10}[.,]*\s+(?=\d)")
# The zones of words that mean one thing in all countries: CST is of Chicago and of China.
OFFSETS = {
    "UTC": "+0000", "GMT": "+0000", "CET": "+0100", "MEZ": "+0100", "CEST": "+0200", "MESZ": "+0200", "EET": "+0200",
    "EEST": "+0300", "EST": "-0500", "EDT": "-0400", "CDT": "-0500", "MST": "-0700", "MDT": "-0600", "PST": "-0800",
    "PDT": "-0700", "AKST": "-0900", "AKDT": "-0800", "AEST": "+1000", "AEDT": "+1100",
}  # fmt: skip
HALF_WITH_POINTS = re.compile(r"([AaPp])\.\s?[Mm]\.")
ZONE_WORD = re.compile(
    rf"\s*\b(?P<word>{'|'.join(OFFSETS)})(?:\s?(?P<sign>[+-])(?P<hours>\d{{1,2}}):?(?P<minutes>\d\d)?)?(?=$|\s\d{{4}}$)"
)
JAVA = re.compile(
    r"^(?P<month>[^\W\d_]{3,9}) (?P<day>\d{1,2}) (?P<clock>\d\d:\d\d:\d\d) ?(?P<zone>[+-]\d{4})? (?P<year>\d{4})$"
)
SOME = 0.05  # of the dates, whose form counts
LEAST_YEAR, MOST_YEAR = 1990, 2100  # years that a stamp of a record may have
ORDERS = {"dmy": ("%d", "%m", "%y"), "mdy": ("%m", "%d", "%y"), "ymd": ("%y", "%m", "%d")}


def form_of(texts: Sequence[str], where: str) -> str:
    """The form, as of strptime, of most of the dates, of which `plain_date` may have to be taken; empty for no dates.

    RecordError where day and month, or year and day, cannot be told apart.
    """
    named = 2 * sum(_month_by_name(t) for t in texts) > len(texts)
    plain = [plain_date(t) for t in texts]
    compact = [m for m in map(COMPACT.match, plain) if m]
    if 2 * len(compact) > len(plain):
        return _compact(compact)
    found = [m for m in map(DATE.match, plain) if m and len(m["a"]) != 3]
    if 2 * len(found) <= len(plain):
        return ""
    sign = Counter(m["sign"] for m in found).most_common(1)[0][0]
    own = [m for m in found if m["sign"] == sign]
    tails = Counter(tail for m in own if (tail := _tail(m["rest"])) is not None)
    if 2 * sum(tails.values()) <= len(plain):
        return ""
    # What is zero may be left out, so that the longest form has all parts.
    tail = max((t for t, n in tails.items() if n >= SOME * len(own)), key=len)
    order = ("%d", "%b", "%Y" if len(own[0]["c"]) == 4 else "%y") if named else _order(own, texts[0], tail, where)
    order = ("%Y", "%b", "%d") if named and len(own[0]["a"]) == 4 else order
    return sign.join(order) + tail


def plain_date(text: str) -> str:
    """The date as strptime reads it: no day of the week, a month's number for its name, +0100 for CET, pm for p.m."""
    text = ZONE_WORD.sub(_offset, HALF_WITH_POINTS.sub(r"\1m", text))
    if (java := JAVA.match(_without_weekday(text))) is not None and (number := MONTH.get(java["month"].lower())):
        return f"{java['day']} {number:02d} {java['year']} {java['clock']}{java['zone'] or ''}"
    american = re.match(r"^([^\W\d_]{3,9})\.? (\d{1,2}),? (\d{4})(.*)$", text)
    if american and american[1].lower() in MONTH:
        return f"{american[2]} {MONTH[american[1].lower()]:02d} {american[3]}{american[4]}"
    text = WEEKDAY.sub("", text)
    return WORD.sub(lambda m: f"{MONTH[w]:02d}" if (w := m[0].lower().rstrip(".")) in MONTH else m[0], text)


def _offset(match: re.Match[str]) -> str:
    """The offset of CET, or of GMT+2."""
    if not match["sign"] or match["word"] not in {"UTC", "GMT"}:
        return OFFSETS[match["word"]] + (match[0][match.end("word") - match.start() :])
    return f"{match['sign']}{int(match['hours']):02d}{match['minutes'] or '00'}"


def _without_weekday(text: str) -> str:
    """Mon Mar 04 ... without its first word."""
    first, _, rest = text.partition(" ")
    return rest if first.isalpha() and rest[:1].isalpha() else text


def other_forms(form: str) -> Iterator[str]:
    """Forms of the same dates with a fraction of a second, or without what is zero: fraction, seconds, time."""
    form = form.replace("%b", "%m")
    yield form
    if "%f" in form:
        yield re.sub(r"[.,:]%f", "", form)
    elif "%S" in form:
        yield form.replace("%S", "%S.%f")
    if "%S" in form:
        yield re.sub(r"[:.]%S([.,:]%f)?", "", form)
    if "%H" in form or "%I" in form:
        yield re.split(r"[T ,;]*%[HI]", form)[0]


def _month_by_name(text: str) -> bool:
    return any(m.lower().rstrip(".") in MONTH for m in WORD.findall(text))


def calendar_digits(values: Sequence[float], *, days: bool) -> str:
    """The form of numbers that are dates without signs, as 20240304060000 or ``days``; empty where they are none."""
    texts = [f"{v:.0f}" for v in values if v == v // 1]
    if len(texts) < len(values) or len({len(t) for t in texts}) != 1:
        return ""
    form = {14: "%Y%m%d%H%M%S", 12: "%Y%m%d%H%M", 8: "%Y%m%d" * days}.get(len(texts[0]), "")
    return form if form and all(_is_date(t, form) for t in texts) else ""


def _is_date(text: str, form: str) -> bool:
    try:
        return LEAST_YEAR <= datetime.strptime(text, form).year <= MOST_YEAR
    except ValueError:
        return False


def _compact(found: Sequence[re.Match[str]]) -> str:
    first = found[0]
    clock, rest = first["clock"] or "", first["rest"]
    form = "%Y%m%d" + first["sign"]
    if ":" in clock:
        form += ":".join(["%H", "%M", "%S"][: clock.count(":") + 1])
    elif clock:
        form += "%H%M%S"[: len(clock)]
    digits = rest.rstrip("Z")
    return form + (f"{digits[0]}%f" if digits else "") + ("%z" if rest.endswith("Z") else "")


def _tail(rest: str) -> str | None:
    """The form of what stands after the date; None where it is no time of the day."""
    if not rest.strip():
        return ""
    match = REST.match(rest)
    if match is None:
        return None
    if match["sign"] is None:
        return match["gap"] + "%H%M%S"
    half = " %p" if match["half"] else ""
    clock = ["%I" if half else "%H", "%M", "%S"][: match["clock"].count(match["sign"]) + 1]
    part = f"{match['part'][0]}%f" if match["part"] else ""
    half = half if not half or re.search(r"\d\s+[AaPp]", rest) else "%p"
    zone = "" if not match["zone"] else " %z" if re.search(r"\s(?:Z|[+-]\d\d:?\d\d)$", rest) else "%z"
    return match["gap"] + match["sign"].join(clock) + part + half + zone


def _order(found: Sequence[re.Match[str]], first: str, tail: str, where: str) -> tuple[str, ...]:
    """The order of day, month and year of dates with one sign between them; ``tail`` is the form of what follows."""
    sign, long_year = found[0]["sign"], len(found[0]["c"]) == 4
    if len(found[0]["a"]) == 4:
        return "%Y", "%m", "%d"
    numbers = [(int(m["a"]), int(m["b"]), int(m["c"])) for m in found]
    a, b, c = (max(n[i] for n in numbers) for i in range(3))
    possible = {
        "dmy": a <= 31 and b <= 12,
        "mdy": a <= 12 and b <= 31 and sign != ".",
        "ymd": not long_year and b <= 12 and c <= 31 and (sign == "-" or a > 31),
    }
    if sign == "." and possible["dmy"]:
        possible["ymd"] = False
    orders = [order for order, may in possible.items() if may]
    if len(orders) > 1:
        orders = _steady(numbers, orders)
    if len(orders) != 1:
        if not orders:
            raise RecordError(f"{where}: {first!r} is no date of a day, a month and a year; export ISO-8601 times")
        what = "month/day or day/month" if {*orders} <= {"dmy", "mdy"} else "day or year first"
        forms = [sign.join("%Y" if p == "%y" and long_year else p for p in ORDERS[o]) + tail for o in orders]
        raise RecordError(
            f"{where}: {first!r} may be {what}; give --time-format {' or '.join(map(repr, forms[:2]))}, or export "
            "ISO-8601 times"
        )
    order = ORDERS[orders[0]]
    return tuple("%Y" if part == "%y" and long_year else part for part in order)


def _steady(numbers: Sequence[tuple[int, int, int]], orders: Sequence[str]) -> list[str]:
    """The orders in which the dates go on by a day at a time, where they are dates of several days; else all."""
    days: dict[str, list[int]] = {}
    for order in orders:
        try:
            parts = [dict(zip(order, n, strict=True)) for n in numbers]
            days[order] = [datetime(2000 + p["y"] % 100, p["m"], p["d"]).toordinal() for p in parts]
        except ValueError:
            continue
    spans = {order: max(d) - min(d) for order, d in days.items()}
    different = len(set(numbers))
    if different < 2:
        return list(orders)
    # Consecutive days are as many as the span between the first and the last; months and years are not.
    near = [order for order, span in spans.items() if span <= 3 * different]
    return near if len(near) == 1 else list(orders)
