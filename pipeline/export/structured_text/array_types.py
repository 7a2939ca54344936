"""Arrays of variables by named types, which every system lets a whole array be assigned and handed over by.

By IEC 61131-3 two arrays that are declared in place have two types, whatever their bounds: a strict compiler refuses
``mv := before`` and ``law(pv := pv_used)`` between them. With one named type for each size they have one.
"""

from __future__ import annotations

import re
from collections.abc import Sequence

# A variable's array without initial values of a table: what stands in VAR CONSTANT is read entry by entry alone.
_IN_PLACE = re.compile(r"(?m)^(    \w+ : )ARRAY\[0\.\.(\d+)\] OF (LREAL|DINT|BOOL)\b")
_ROOM = re.compile(r"(?ms)^VAR(?:_INPUT|_OUTPUT)?\n.*?^END_VAR$")


def with_named_arrays(name: str, texts: Sequence[str]) -> tuple[list[str], list[str]]:
    """One TYPE for each kind and size of array in the ``texts``, and the texts with these names.

    ``pv : ARRAY[0..1] OF LREAL`` becomes ``pv : NAME_lreal_2``. Constant tables stay as they are.
    """
    found: set[tuple[str, int]] = set()

    def named(match: re.Match[str]) -> str:
        kind, count = match[3], int(match[2]) + 1
        found.add((kind, count))
        return f"{match[1]}{name}_{kind.lower()}_{count}"

    changed = [_ROOM.sub(lambda room: _IN_PLACE.sub(named, room[0]), text) for text in texts]
    types = [
        f"TYPE {name}_{kind.lower()}_{count} : ARRAY[0..{count - 1}] OF {kind};\nEND_TYPE\n"
        for kind, count in sorted(found)
    ]
    return types, changed
