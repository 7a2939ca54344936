"""What a header of an export says: the tag, and its unit in brackets."""

from __future__ import annotations

import re

from pipeline.records.record_file import split_column

ROUND = re.compile(r"^(?P<name>.*\S)\s*\((?P<unit>[^()]{1,16})\)$")
# A unit in round brackets, which may hold any words: these, with prefixes and powers, their products and quotients.
BASES = (
    "%|°|°C|°F|degC|degF|deg|grd|K|C|F|m|g|t|l|L|s|sec|h|hr|min|d|bar|barg|bara|Pa|psi|psig|A|V|W|VA|var|Wh|J|Hz|N|Nm|mol|"
    "M|pH|ppm|ppb|rpm|lb|ft|in|gal|gpm|bbl|BTU|S|cP|Ω|Nm3|Sm3|m3|vol|vol%|wt%|pct"
)
ONE = rf"[kmµuMGcdh]?(?:{BASES})(?:[²³0-9]|\^-?[0-9])?"
UNIT = re.compile(rf"^{ONE}(?:[/*·.\s]?{ONE})*$")


def split_header(column: str) -> tuple[str, str]:
    """(tag, unit) of a header: of ``TIC-7.PV [degC]``, ``TIC-7.PV (°C)``; the unit is empty where none is written.

    Round brackets hold a unit only where they look like one: ``FI-7 (raw)`` is a tag, and ``P-7 (A)`` a pump.
    """
    name, unit = split_column(column)
    match = None if unit else ROUND.match(name)
    found = match["unit"].strip() if match else ""
    if match is None or not UNIT.match(found) or (len(found) == 1 and found.isupper()):
        return name, unit
    return match["name"], found
