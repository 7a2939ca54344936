"""What the pages of examples/embed and docs/embedding.md say of files, versions and the kit is so."""

from __future__ import annotations

import json
import re
from collections import Counter
from pathlib import Path
from typing import Any

import pytest
from kits import EMBED, ROOT, SHIPPED, kit_of

from loopwright.serving import Controller
from loopwright.serving.conformance.kit import VECTORS
from loopwright.serving.graph.audit import audit

PLC = (EMBED / "plc" / "README.md").read_text()
DOCS = (ROOT / "docs" / "embedding.md").read_text()


def row(text: str, name: str) -> str:
    """The cell beside ``name`` in a table."""
    return next(line.split("|")[2] for line in text.splitlines() if line.startswith(f"| {name} |"))


def test_the_plc_page_names_the_operators_and_formats_of_the_shipped_files() -> None:
    graphs = [audit(file.read_bytes()) for file in SHIPPED]
    assert re.findall(r"`(\w+)`", row(PLC, "operators")) == sorted({op for graph in graphs for op in graph.ops})
    (opset,) = {graph.opset for graph in graphs}
    (version,) = {graph.ir_version for graph in graphs}
    assert f"opset {opset}, IR {version}, no external data" in row(PLC, "format")
    largest = re.search(r"at most (\d+) kB", row(PLC, "format"))
    assert largest is not None
    assert 0.8 * int(largest[1]) < max(file.stat().st_size for file in SHIPPED) / 1e3 <= int(largest[1])
    assert "**Nothing on this page was tested here**" in PLC


def test_the_plc_page_names_the_inputs_and_outputs() -> None:
    for file in SHIPPED:  # that each is float64 of fixed length is what opening the file checks
        assert set(Controller(file).manifest.inputs) <= set(re.findall(r"`(\w+)`", row(PLC, "inputs")))
    assert re.findall(r"`(\w+)`", row(PLC, "outputs"))[:3] == ["mv", "state_next", "info"]


HOSTS = ["python", "c", "c/onnxruntime", "node", "browser"]


@pytest.mark.parametrize("host", HOSTS)
def test_each_host_has_a_short_page_that_says_the_same_four_things(host: str) -> None:
    text = (EMBED / host / "README.md").read_text()
    assert len([line for line in text.splitlines() if line.strip() and not line.startswith(("```", "<!--"))]) <= 11
    for what in ("**State**", "**Loop**", "**Fault**", "loopwright conformance FILE.onnx KIT"):
        assert what in text


@pytest.mark.parametrize("host", HOSTS)
def test_each_page_says_how_a_loop_begins_and_what_a_host_lacks(host: str) -> None:
    text = (EMBED / host / "README.md").read_text().casefold()
    assert (
        "before the first good sample with a read-back" in text
        or "**start**, **fault**, what is **not here**: as in node" in text
    )
    assert (
        "a ramp after a change to auto" in text and "a fault that lasts" in text
    ) or "**not here**: as in node" in text


@pytest.mark.parametrize(("host", "package"), [("node", "onnxruntime-node"), ("browser", "onnxruntime-web")])
def test_versions_are_pinned_and_named(host: str, package: str) -> None:
    version = json.loads((EMBED / host / "package.json").read_text())["dependencies"][package]
    assert re.fullmatch(r"\d+\.\d+\.\d+", version)
    assert f"{package} {version}" in (EMBED / "README.md").read_text()
    lock: dict[str, Any] = json.loads((EMBED / host / "package-lock.json").read_text())
    assert lock["packages"][f"node_modules/{package}"]["version"] == version
    assert all(part.get("integrity") and "resolved" not in part for name, part in lock["packages"].items() if name)


def test_the_manual_describes_the_kit() -> None:
    vectors = json.loads((kit_of(SHIPPED[0]) / VECTORS).read_text())
    described = set(re.findall(r"`(\w+)`", DOCS))
    named = {*vectors, *vectors["steps"][0], *vectors["scans"][0], *vectors["steps"][0]["gives"]}
    assert named - {"kit", "what", "pv_margin"} <= described
    assert float.fromhex(vectors["tolerance"]) == 1e-9
    assert float.fromhex(vectors["chained_tolerance"]) == 1e-6
    assert "the largest difference allowed in one step (1e-9) and chained (1e-6)" in DOCS.replace("\n", " ")
    parts = Counter(step["part"] for step in vectors["steps"])
    for part, words in (
        ("anywhere", "60 with inputs anywhere"),
        ("inside", "60 whose MV lies inside"),
        ("course", "80 on a slow course"),
        ("saturation", "50 at the ends"),
        ("stuck actuator", "50 with a stuck actuator"),
    ):
        assert words in DOCS.replace("\n", " ")
        assert parts[part] == int(words.split()[0])


PAGES = [EMBED / "README.md", *(EMBED / host / "README.md" for host in [*HOSTS, "plc"]), ROOT / "docs" / "embedding.md"]


@pytest.mark.parametrize("page", PAGES, ids=lambda page: f"{page.parent.name}-{page.stem}")
def test_links_of_the_pages_resolve(page: Path) -> None:
    for link in re.findall(r"\]\(([^)#]+)(?:#[\w-]+)?\)", page.read_text()):
        assert (page.parent / link).exists(), link
