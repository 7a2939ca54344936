"""PVs that no MV moves are named, and with more PVs than MVs it is said which are controlled."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from dirty_plant import TAGS, cells, clean, screen, write

from loopwright.pipeline.historian.cleaning.findings import Finding
from loopwright.pipeline.historian.cleaning.tags import Tag

AMBIENT = Tag("SITE_TI_99.PV", "pv", "degC")


def found_of(folder: Path, tags: tuple[Tag, ...]) -> list[Finding]:
    random = np.random.default_rng(3)
    data = clean()
    t = np.arange(len(data.pv))
    ambient = np.round(12 + 8 * np.sin(2 * np.pi * t / 900) + random.normal(0, 0.1, len(t)), 2)
    rows = [[*row, f"{a}"] for row, a in zip(cells(data), ambient, strict=True)]
    path = write(folder / "x.csv", rows, ("timestamp", *(tag.tag for tag in TAGS), AMBIENT.tag))
    return [f for f in screen(path, tags).report.findings if f.kind in {"unmoved", "controlled"}]


def test_a_pv_that_no_mv_moves_is_named_and_which_pv_is_controlled(tmp_path: Path) -> None:
    unmoved, controlled = found_of(tmp_path, (*TAGS, AMBIENT))
    assert (unmoved.tag, unmoved.words) == (AMBIENT.tag, "answers to no MV: leave its role empty, or make it dv")
    assert controlled.tag == "TIC-101.PV"
    assert "the first of 2 PVs for 1 MV; SITE_TI_99.PV will not" in controlled.words


def test_pvs_that_the_mv_moves_need_no_words(tmp_path: Path) -> None:
    assert not found_of(tmp_path, TAGS)
