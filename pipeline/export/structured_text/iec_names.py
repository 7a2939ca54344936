"""Names and numbers that CODESYS, TwinCAT and Siemens SCL all read.

A name has letters, digits and single underscores, a letter first, none last. Upper and lower case are the same name.
Words of the languages and of their standard libraries are no names, nor are absolute addresses such as ``M1``.
"""

from __future__ import annotations

import re
from collections.abc import Sequence

from loopwright.pipeline.errors import ExportError
from loopwright.pipeline.export.plain_code.layout import WIDTH
from loopwright.pipeline.export.plain_code.printed_functions import number
from loopwright.serving.manifest import Manifest

MOST_LETTERS = 60  # of a controller's name: with what is put behind it a name stays below the 125 letters of SCL
# Words that a case, a law or a tag could give, and that one of the three systems keeps for itself.
_WORDS = """abs action and any array at begin bool by byte case char concat configuration const constant continue date
    delete derivative dint div do dt dword else elsif en end eno exit exp expt false find for function goto if
    insert int integral interface label left len limit ln log lreal max mid min mod move mux not null of on or
    organization program real region repeat replace resource ret return right rol ror sel shl shr sin sint sqrt
    step string struct tan task then this time to tod transition trunc true type udint uint ulint union until
    usint var version void while with word xor"""
RESERVED = frozenset(_WORDS.split())
_ADDRESS = re.compile(r"(i|q|m|e|a|t|z|c|p|b|w|d|l|db|fb|fc|ob|ib|iw|id|qb|qw|qd|mb|mw|md|pi|pq|udt|sfc|sfb)\d+")


def plain_words(text: str) -> str:
    """Small letters and digits of a text, joined by single underscores; may be empty."""
    return re.sub(r"[^a-z0-9]+", "_", text.lower()).strip("_")


def st_name(manifest: Manifest) -> str:
    """A name for the blocks, of the case and the law."""
    found = plain_words(f"{manifest.case}_{manifest.law}")[:MOST_LETTERS].strip("_")
    return found if _legal(found) else f"law_{found}".strip("_")


def require_st_name(name: str) -> str:
    """``name``; ExportError where one of the three systems would refuse it."""
    if not _legal(name) or len(name) > MOST_LETTERS:
        raise ExportError(
            f"{name!r} is no name for Structured Text here; take at most {MOST_LETTERS} small letters, digits and "
            "single underscores, a letter first, and no word of the language"
        )
    return name


def field_names(texts: Sequence[str]) -> list[str]:
    """A name for each entry of a STRUCT, all different: ``TIC-1.low`` gives ``tic_1_low``."""
    found: list[str] = []
    for text in texts:
        base = plain_words(text)
        name = base if _legal(base) else f"tag_{base}".strip("_")
        k = 2
        while name in found:
            name = f"{base}_{k}" if _legal(f"{base}_{k}") else f"tag_{base}_{k}"
            k += 1
        found.append(name)
    return found


def _legal(name: str) -> bool:
    spelt = re.fullmatch(r"[a-z][a-z0-9]*(_[a-z0-9]+)*", name) is not None
    return spelt and name not in RESERVED and not _ADDRESS.fullmatch(name)


def lreal(value: float) -> str:
    """The shortest literal of IEC 61131-3 that reads back as the same double: a point is before each exponent."""
    mantissa, _, exponent = number(value).partition("e")
    point = "" if "." in mantissa else ".0"
    return f"{mantissa}{point}" + (f"E{int(exponent):+03d}" if exponent else "")


def typed(value: float) -> str:
    """A number within an expression: its type stands with it, since some compilers take 0.1 for a REAL."""
    text = lreal(abs(value))
    return f"(-LREAL#{text})" if str(float(value)).startswith("-") else f"LREAL#{text}"


def array_of(kind: str, values: Sequence[float] | Sequence[int] | Sequence[bool]) -> str:
    """Type and initial values of an array that begins at 0; its numbers in lines."""
    texts = [lreal(v) if kind == "LREAL" else str(v).upper() for v in values]
    lines, line = [], ""
    for text in texts:
        if line and len(line) + len(text) + 2 > WIDTH:
            lines.append(line)
            line = ""
        line += f"{', ' if line else ''}{text}"
    lines.append(line)
    body = lines[0] if len(lines) == 1 else "\n        " + ",\n        ".join(lines)
    return f"ARRAY[0..{len(values) - 1}] OF {kind} := [{body}]"


def comment(text: str) -> str:
    """A text of a manifest, in a comment."""
    return text.replace("*)", "* )").replace("(*", "( *").replace("\n", " ")
