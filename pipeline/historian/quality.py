"""Quality of a reading, as historians write it."""

from __future__ import annotations

from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from numpy.typing import NDArray

GOOD = {"good", "ok", "g", "valid", "true", "normal", "192", "good, non-specific", "good (192)", "0x000000c0"}
OPC_GOOD, OPC_CODES = 192, 64
"""OPC classic: bits 7 and 6 both set are good; codes from 64 on tell an OPC quality from a plain flag."""


def good_quality(column: Any) -> NDArray[np.bool_]:
    """Which cells (n,) say that the reading is good.

    Texts: good, ok, valid and their like. Numbers: from 192 on where OPC codes stand in the column; of plain flags
    (0 and 1) the one that most rows have.
    """
    if pa.types.is_dictionary(column.type):
        column = pc.cast(column, column.type.value_type)
    if pa.types.is_boolean(column.type):
        return np.asarray(pc.fill_null(column, False).to_numpy(zero_copy_only=False), dtype=bool)
    text = pc.fill_null(pc.utf8_lower(pc.utf8_trim_whitespace(pc.cast(column, pa.string()))), "")
    counts = {row["values"]: row["counts"] for row in pc.value_counts(text).to_pylist()}
    good = {t for t in counts if t in GOOD or t.startswith("good")}
    figures = {t: float(t) for t in counts if t.lstrip("+-").replace(".", "", 1).isdigit()}
    if figures and max(figures.values()) >= OPC_CODES:
        good |= {t for t, v in figures.items() if v >= OPC_GOOD}
    elif figures:
        good.add(max(figures, key=lambda t: counts[t]))
    if not good:
        return np.zeros(len(text), dtype=bool)
    return np.asarray(pc.is_in(text, value_set=pa.array(sorted(good))).to_numpy(zero_copy_only=False), dtype=bool)
