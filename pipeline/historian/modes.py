"""Modes of which a person leaves rows out: each must be one that the export has."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from loopwright.pipeline.errors import RecordError, nearest
from loopwright.pipeline.historian.export import Series
from loopwright.pipeline.historian.tags import Tag


def check_modes(without: Sequence[str], tags: Sequence[Tag], own: Mapping[str, Series]) -> None:
    """RecordError for a mode ``without`` that no tag of role mode has, with those that they have."""
    known = {t.tag: own[t.tag].categories for t in tags if t.role == "mode"}
    if without and not known:
        raise RecordError(
            f"--without-mode {without[0]}: no tag has the role mode; name the tag of the mode with --mode TAG, or "
            "leave --without-mode out"
        )
    names = {name for of_tag in known.values() for name in of_tag}
    for mode in without:
        if mode not in names:
            has = "; ".join(f"{tag} has the modes {', '.join(of_tag)}" for tag, of_tag in known.items())
            raise RecordError(f"--without-mode {mode}: {has}{nearest(mode, names)}")
