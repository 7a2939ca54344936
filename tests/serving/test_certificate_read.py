"""A certificate as the runtime reads it: whose it is, what it says, and what is not believed."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import onnx
import pytest

from loopwright.pipeline.evaluation.certificate.bound import at_most_fail
from loopwright.pipeline.export.controller_file import file_bytes, with_evidence
from loopwright.serving import ArtifactError, Controller
from loopwright.serving.card import card
from loopwright.serving.certificate import Certificate, CertifiedFamily, certificate_of
from loopwright.serving.controller_file import controller_files, law_in
from loopwright.serving.in_charge.adapted import AdaptedController
from loopwright.serving.station.views import _card

ROOT = Path(__file__).parents[2]
FILES = [file for case in sorted((ROOT / "artifacts").iterdir()) if case.is_dir() for file in controller_files(case)]
FILE = ROOT / "artifacts/ph_neutralization/pid.onnx"
FAMILY = CertifiedFamily(
    "ph_neutralization", "f" * 64, 1, ("step",), (9001,), {"A": (1.0, 2.0)}, 0.02, (0.0, 1.0), (0.5, 2.0), 0.5, 0.5,
    ("stuck",), ("sensors that fail",),
)  # fmt: skip


def made(loops: int = 459, failures: int = 0, confidence: float = 0.99, **other: Any) -> Certificate:
    at_most = at_most_fail(failures, loops, confidence)
    whole = {"law": "a" * 64, "plan": "b" * 64, "seed": 1, "fails_if": ("locked up",), "family": FAMILY}
    return Certificate(loops=loops, failures=failures, confidence=confidence, **{"at_most": at_most, **whole, **other})


def certified_file(folder: Path, tree: Any) -> Controller:
    target = folder / FILE.name
    with_evidence(FILE, target, {**Controller(FILE).manifest.evidence, "certificate": tree})
    return Controller(target)


# ---------------------------------------------------------------------- the law's digest
@pytest.mark.parametrize("file", FILES, ids=lambda file: f"{file.parent.name}-{file.stem}")
def test_a_law_keeps_its_digest_whatever_is_known_of_it(file: Path, tmp_path: Path) -> None:
    with_evidence(file, tmp_path / file.name, {"anything": [1, 2]})
    before, after = Controller(file), Controller(tmp_path / file.name)
    assert before.law_sha256 == after.law_sha256 == law_in(file.read_bytes())
    assert before.sha256 != after.sha256


def test_another_contract_or_graph_is_another_law(tmp_path: Path) -> None:
    manifest = Controller(FILE).manifest
    model = onnx.load(FILE)
    del model.metadata_props[:]
    digests = {law_in(file_bytes(model.SerializeToString(), manifest))}
    wider = replace(manifest, mv=(replace(manifest.mv[0], high=2 * manifest.mv[0].high), *manifest.mv[1:]))
    digests.add(law_in(file_bytes(model.SerializeToString(), wider)))
    digests.add(law_in(file_bytes(model.SerializeToString(), replace(manifest, period_s=2 * manifest.period_s))))
    weights = next(t for t in model.graph.initializer if t.data_type == onnx.TensorProto.DOUBLE and t.raw_data)
    weights.raw_data = bytes([weights.raw_data[0] ^ 1]) + weights.raw_data[1:]
    digests.add(law_in(file_bytes(model.SerializeToString(), manifest)))
    assert len(digests) == 4
    with pytest.raises(ArtifactError):
        law_in(b"no controller")


# ---------------------------------------------------------------------- what it says
@pytest.mark.parametrize(
    ("loops", "failures", "percent"),
    [(459, 0, "1 %"), (458, 0, "1.1 %"), (4603, 0, "0.1 %"), (90, 0, "5 %"), (459, 14, "5.5 %"), (8, 8, "100 %")],
)
def test_a_share_is_rounded_up(loops: int, failures: int, percent: str) -> None:
    one = made(loops, failures)
    assert f"at most {percent} fail" in one.sentence
    assert float(percent.split()[0]) / 100 >= min(one.at_most, 1.0) * (1 - 1e-9)


def test_a_small_test_says_so() -> None:
    assert made(458).small
    assert not made(459).small
    assert "459 can show 1 %" in made(90).sentence
    assert "small" not in made(459).sentence


def test_the_lines_say_what_a_failure_is_and_what_was_not_drawn() -> None:
    one = made(459, 3, limits={"mae": 0.5}, failed={"7": ("locked up",), "8": ("mae 0.6",), "9": ("mae 0.7",)})
    said = "\n".join(one.lines)
    assert "locked up or has mae above 0.5" in said
    assert "sensors that fail" in said
    assert "7 (locked up)" in said
    assert len(made().lines) == 4
    assert Certificate.from_dict(one.to_dict()) == one


# ---------------------------------------------------------------------- what is believed
def test_inspect_and_page_show_it(tmp_path: Path) -> None:
    law = Controller(FILE).law_sha256
    shown = certified_file(tmp_path, made(law=law).to_dict())
    assert made().sentence in card(shown)
    assert _card(shown)["certificate"] == {"lines": list(made().lines), "wrong": ""}
    adapted = AdaptedController(shown, shown.manifest)
    assert certificate_of(adapted.manifest, adapted.law_sha256).certificate == made(law=law)
    assert certificate_of(Controller(FILE).manifest, law).lines == ()


def test_that_of_another_law_is_not_believed(tmp_path: Path) -> None:
    found = certified_file(tmp_path, made().to_dict())
    read = certificate_of(found.manifest, found.law_sha256)
    assert read.certificate is None
    assert "another law" in read.wrong
    assert made().sentence not in card(found)
    assert "NOT TO BE BELIEVED" in card(found)
    assert _card(found)["certificate"]["lines"] == [read.wrong]


@pytest.mark.parametrize(
    "changed",
    [
        {"at_most": 0.005},  # smaller than the loops show
        {"failures": 3},
        {"failures": 460},
        {"loops": 10**12},
        {"loops": "459"},
        {"confidence": 1.0},
        {"confidence": 0.999},
        {"fails_if": []},
        {"family": {}},
        {"failed": {"1": "locked up"}},
        {"more": 1},
    ],
)
def test_what_its_numbers_do_not_show_is_not_believed(changed: dict[str, Any], tmp_path: Path) -> None:
    law = Controller(FILE).law_sha256
    found = certified_file(tmp_path, {**made(law=law).to_dict(), **changed})
    read = certificate_of(found.manifest, law)
    assert read.certificate is None
    assert "cannot be read" in read.wrong
    assert "NOT TO BE BELIEVED" in card(found)


@pytest.mark.parametrize("tree", [1, [], "1 % fail", {}])
def test_what_is_no_certificate_is_none(tree: Any, tmp_path: Path) -> None:
    found = certified_file(tmp_path, tree)
    assert certificate_of(found.manifest, found.law_sha256).wrong
