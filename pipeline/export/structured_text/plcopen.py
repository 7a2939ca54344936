"""All blocks in one PLCopen XML file (TC6, version 2.0), which CODESYS, TwinCAT and others import.

The printed text is the source: its declarations become the elements of an interface, its statements the body.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from xml.sax.saxutils import escape, quoteattr

WHEN = "2000-01-01T00:00:00"  # the same file for the same controller
_KINDS = {"FUNCTION": "function", "FUNCTION_BLOCK": "functionBlock", "PROGRAM": "program"}
_ROOMS = {
    "VAR_INPUT": "<inputVars>", "VAR_OUTPUT": "<outputVars>", "VAR": "<localVars>",
    "VAR CONSTANT": '<localVars constant="true">',
}  # fmt: skip
_ELEMENTARY = ("LREAL", "DINT", "BOOL")
_DECLARED = re.compile(
    r"^ +(?P<name>\w+) : (?:ARRAY\[0\.\.(?P<last>\d+)\] OF )?(?P<type>\w+)(?: := (?P<value>[^;]*))?;", re.M
)
_COMMENT = re.compile(r"\(\*.*?\*\)", re.S)


def plcopen_xml(name: str, version: str, units: Sequence[str]) -> str:
    """The project of these texts, each a TYPE, FUNCTION, FUNCTION_BLOCK or PROGRAM."""
    bare = [_first_word(unit) for unit in units]
    types = [_structure(unit) for unit, kind in zip(units, bare, strict=True) if kind == "TYPE"]
    pous = [_pou(unit) for unit, kind in zip(units, bare, strict=True) if kind != "TYPE"]
    scaling = "".join(f'<{language}><scaling x="1" y="1"/></{language}>' for language in ("fbd", "ld", "sfc"))
    return "\n".join(
        [
            '<?xml version="1.0" encoding="utf-8"?>',
            '<project xmlns="http://www.plcopen.org/xml/tc6_0200">',
            f'<fileHeader companyName="" productName="Loopwright" productVersion={quoteattr(version)} '
            f'creationDateTime="{WHEN}"/>',
            f'<contentHeader name={quoteattr(name)} modificationDateTime="{WHEN}">',
            f"<coordinateInfo>{scaling}</coordinateInfo>",
            "</contentHeader>",
            "<types>",
            *("<dataTypes>", *types, "</dataTypes>"),
            *("<pous>", *pous, "</pous>"),
            "</types>",
            "<instances><configurations/></instances>",
            "</project>\n",
        ]
    )


def _first_word(unit: str) -> str:
    return _COMMENT.sub("", unit).split(maxsplit=1)[0]


def _structure(unit: str) -> str:
    name = _COMMENT.sub("", unit).split()[1]
    array = re.fullmatch(r"TYPE \w+ : ARRAY\[0\.\.(\d+)\] OF (\w+);\s*END_TYPE\s*", unit)
    if array is not None:
        base = _array_type(array[1], f"<{array[2]}/>")
        return f"<dataType name={quoteattr(name)}><baseType>{base}</baseType></dataType>"
    fields = "".join(_variables(_COMMENT.sub("", unit)))
    return f"<dataType name={quoteattr(name)}><baseType><struct>{fields}</struct></baseType></dataType>"


def _pou(unit: str) -> str:
    start = re.search(r"^(FUNCTION_BLOCK|FUNCTION|PROGRAM) (\w+)(?: : (\w+))?\n", unit, re.M)
    assert start is not None
    kind, name, result = start.groups()
    last = unit.rindex("\nEND_VAR\n") + len("\nEND_VAR\n")
    declarations, body = unit[start.end() : last], unit[last : unit.rindex(f"END_{kind}")]
    interface = [f"<returnType><{result}/></returnType>"] if result else []
    for room, text in re.findall(r"^(VAR(?:_INPUT|_OUTPUT| CONSTANT)?)\n(.*?)^END_VAR$", declarations, re.S | re.M):
        begin = _ROOMS[room]
        interface.append(
            f"{begin}{''.join(_variables(_COMMENT.sub('', text)))}</{begin[1:].split(maxsplit=1)[0].strip('>')}>"
        )
    words = unit[: start.start()].strip()
    text = f"{words}\n{body}" if words else body
    return (
        f'<pou name="{name}" pouType="{_KINDS[kind]}"><interface>{"".join(interface)}</interface>'
        f'<body><ST><xhtml xmlns="http://www.w3.org/1999/xhtml">{escape(text)}</xhtml></ST></body></pou>'
    )


def _variables(text: str) -> Iterator[str]:
    for found in _DECLARED.finditer(text):
        kind = found["type"]
        base = f"<{kind}/>" if kind in _ELEMENTARY else f"<derived name={quoteattr(kind)}/>"
        declared = base if found["last"] is None else _array_type(found["last"], base)
        given = (found["value"] or "").strip()
        value = "" if not given else _array(given) if given.startswith("[") else _simple(given)
        initial = f"<initialValue>{value}</initialValue>" if value else ""
        yield f'<variable name="{found["name"]}"><type>{declared}</type>{initial}</variable>'


def _array_type(last: str, base: str) -> str:
    return f'<array><dimension lower="0" upper="{last}"/><baseType>{base}</baseType></array>'


def _simple(value: str) -> str:
    return f"<simpleValue value={quoteattr(value.strip())}/>"


def _array(value: str) -> str:
    values = value.strip().strip("[]").split(",")
    return f"<arrayValue>{''.join(f'<value>{_simple(v)}</value>' for v in values)}</arrayValue>"
