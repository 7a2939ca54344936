"""The playground's files: what the page is told of a case, the folder, the one file, and what is refused."""

from __future__ import annotations

import base64
import gzip
import json
import re
import shutil
import urllib.request
from pathlib import Path
from threading import Thread

import numpy as np
import onnx
import pytest

from loopwright.pipeline.__main__ import main
from loopwright.pipeline.cases import CASES
from loopwright.pipeline.commands.playground import page_of
from loopwright.pipeline.errors import PipelineError
from loopwright.pipeline.files import sha256
from loopwright.pipeline.playground import about
from loopwright.pipeline.playground import web_runtime as runtime
from loopwright.pipeline.playground.site import (
    LOOP,
    OPERATORS,
    SHARED,
    STATIC,
    Playground,
    file_server,
    write_folder,
    write_one_file,
)
from loopwright.serving import Controller

pytest_plugins = ["course_files"]
ARTIFACTS = Path(__file__).parents[2] / "artifacts"
CASE = "reversible_cstr"


@pytest.fixture(scope="module")
def cstr() -> Playground:
    return page_of(CASES[CASE], ARTIFACTS)


@pytest.fixture
def stand_in(tmp_path: Path) -> Path:
    """A folder with files of the runtime's names: these tests open no browser."""
    folder = tmp_path / "runtime"
    folder.mkdir()
    for name in runtime.DIGESTS:
        (folder / name).write_bytes(f"// {name}".encode())
    return folder


def test_the_page_has_of_a_law_all_that_its_host_acts_on(
    previewing: Controller, operated_previewing: Controller
) -> None:
    """Without the input ``ahead`` of a law that reads it, no step of that law has all its inputs."""
    for law, inputs in ((previewing, {"ahead"}), (operated_previewing, {"operate", "fresh", "ahead"})):
        told, manifest = about._controller(law, None), json.loads(law.manifest.to_json())
        assert inputs <= set(told["inputs"])
        acted = re.search(r"ACTED_ON = (\[.*?\])", (LOOP.parent / "controller.mjs").read_text())
        assert acted is not None
        for key in json.loads(acted[1]):
            assert told.get(key) == manifest.get(key), key


@pytest.mark.parametrize("case", CASES)
def test_the_courses_of_the_page_are_those_of_the_tests(case: str) -> None:
    told, plant = page_of(CASES[case], ARTIFACTS).about, CASES[case].plant
    by_hand, *tests = told["tests"]
    wanted = {name: found[0] for name, found in CASES[case].scenarios().items() if found[0].plant is None}
    assert len(tests) == len(wanted)
    assert {row[0] for row in by_hand["course"]} == {0}
    for found, test in zip(tests, wanted.values(), strict=True):
        sp, p = np.full(test.sp.shape, np.nan), np.tile(plant.parameters(), (test.samples, 1))
        for k, what, i, value in found["course"]:
            {"sp": sp, "p": p}[what][k:, i] = value
        np.testing.assert_array_equal(sp, test.sp)
        np.testing.assert_array_equal(p, test.parameters(plant))
        assert (found["x0"], found["mv0"]) == (test.x0.tolist(), test.mv0.tolist())


@pytest.mark.parametrize("case", CASES)
def test_a_slider_reaches_what_a_test_does_and_the_best_stands_beside_the_baseline(case: str) -> None:
    told = page_of(CASES[case], ARTIFACTS).about
    for row in told["parameters"]:
        assert row["low"] < row["value"] < row["high"] or row["value"] in (row["low"], row["high"])
        assert row["low"] < row["high"]
    for test in told["tests"]:
        for _, what, i, value in test["course"]:
            if what == "p":
                assert told["parameters"][i]["low"] <= value <= told["parameters"][i]["high"]
    best = json.loads((ARTIFACTS / case / "validation.json").read_text())["best"]
    assert told["beside"][0] == best
    assert told["beside"][1] == CASES[case].baseline or best == CASES[case].baseline
    assert len(set(told["beside"])) == 2


def test_a_folder_has_all_that_its_pages_name_and_one_copy_of_what_they_share(
    cstr: Playground, stand_in: Path, tmp_path: Path
) -> None:
    folder = tmp_path / "site"
    write_folder(folder, [cstr], stand_in)
    text = (folder / CASE / "index.html").read_text()
    named = set(re.findall(r'"(\.\./[^"]+)"', text))
    assert len(named) > 12
    assert [name for name in named if not (folder / CASE / name).is_file()] == []
    for controller in cstr.controllers:
        assert (folder / CASE / controller.path.name).read_bytes() == controller.path.read_bytes()
    for name in SHARED:
        assert (folder / "static" / name).read_bytes() == (OPERATORS / name).read_bytes()
        assert not (STATIC / name).exists()  # the repository has one copy
    onnx.checker.check_model(onnx.load(folder / CASE / "plant-transition.onnx"), full_check=True)
    # Another case comes beside it, and this one is written again.
    write_folder(folder, [page_of(CASES["jacketed_batch_reactor"], ARTIFACTS), cstr], stand_in)
    links = re.findall(r'<a href="([^"]+)/">', (folder / "index.html").read_text())
    assert links == ["jacketed_batch_reactor", CASE]


def test_every_script_is_in_the_import_map_and_names_no_other_machine() -> None:
    text = (STATIC / "index.html").read_text()
    mapped = set(json.loads(re.search(r'importmap">(.*?)</script>', text, re.S)[1])["imports"])  # type: ignore[index]
    scripts = [LOOP, *(p for p in STATIC.glob("*.js") if p.name != "theme.js")]
    assert {f"loopwright/{p.stem}" for p in scripts} | {"loopwright/format", "onnxruntime-web"} == mapped
    for path in (LOOP, *STATIC.iterdir()):
        assert re.findall(r"https?://", path.read_text()) == []
    for path in scripts:
        assert set(re.findall(r'from "([^"]+)"', path.read_text())) <= mapped


def test_one_file_holds_every_file_and_names_none(cstr: Playground, stand_in: Path, tmp_path: Path) -> None:
    path = tmp_path / "one.html"
    write_one_file(path, cstr, stand_in)
    text = path.read_text()
    assert "../" not in text
    packed = json.loads(re.search(r'id="files">(.*?)</script>', text, re.S)[1])  # type: ignore[index]
    held = {name: gzip.decompress(base64.b64decode(content)) for name, content in packed.items()}
    assert held == {**cstr.files(), runtime.WASM: (stand_in / runtime.WASM).read_bytes()}
    assert "Copyright (c) Microsoft Corporation" in text
    assert "Leon Sorokin" in text
    write_one_file(tmp_path / "again.html", cstr, stand_in)
    assert (tmp_path / "again.html").read_bytes() == path.read_bytes()


def test_a_folder_of_something_else_is_left_alone(cstr: Playground, stand_in: Path, tmp_path: Path) -> None:
    folder = tmp_path / "mine"
    folder.mkdir()
    (folder / "thesis.tex").write_text("years of work")
    with pytest.raises(PipelineError, match=r"holds thesis\.tex, which no playground wrote"):
        write_folder(folder, [cstr], stand_in)
    assert [p.name for p in folder.iterdir()] == ["thesis.tex"]
    with pytest.raises(PipelineError, match="is a file; --out takes a folder"):
        write_folder(folder / "thesis.tex", [cstr], stand_in)
    site = tmp_path / "site"
    (site / "static").mkdir(parents=True)
    (site / "index.html").write_text("a site of somebody")
    (site / "static" / "site.css").write_text("")
    with pytest.raises(PipelineError, match="holds static, which no playground wrote"):
        write_folder(site, [cstr], stand_in)
    assert (site / "static" / "site.css").is_file()


def test_a_file_server_gives_each_file_its_type(cstr: Playground, stand_in: Path, tmp_path: Path) -> None:
    folder = tmp_path / "site"
    write_folder(folder, [cstr], stand_in)
    wanted = {
        "index.html": "text/html; charset=utf-8",
        "case.json": "application/json",
        "pid.onnx": "application/octet-stream",
    }
    kinds = {f"{CASE}/{name}": kind for name, kind in wanted.items()}
    kinds |= {
        f"onnxruntime-web/{runtime.WASM}": "application/wasm",
        f"onnxruntime-web/{runtime.MODULE}": "text/javascript",
    }
    with file_server(folder, 0) as server:
        thread = Thread(target=server.serve_forever)
        thread.start()
        for name, kind in kinds.items():
            with urllib.request.urlopen(f"http://127.0.0.1:{server.server_port}/{name}", timeout=30) as answer:
                assert answer.headers["Content-Type"] == kind
        with pytest.raises(PipelineError, match=f"nothing can listen at 127.0.0.1:{server.server_port}: .*--port"):
            file_server(folder, server.server_port)
        server.shutdown()
        thread.join()


# ---------------------------------------------------------------------- the runtime of the browser
def test_files_that_are_missing_or_are_others_are_refused(stand_in: Path) -> None:
    with pytest.raises(PipelineError, match=f"is not that of onnxruntime-web {runtime.VERSION}: its SHA-256 is"):
        runtime.web_runtime(stand_in)
    (stand_in / runtime.MODULE).unlink()
    with pytest.raises(PipelineError, match=r"bundle\.min\.mjs is missing; give the folder `dist`"):
        runtime.web_runtime(stand_in)


def test_without_npm_it_is_said_how_else(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(PipelineError, match=r"npm is not installed, .* with --runtime"):
        runtime.web_runtime()
    npm = tmp_path / "npm"
    npm.write_text("#!/bin/sh\necho 'npm error network' >&2\nexit 1\n")
    npm.chmod(0o755)
    with pytest.raises(PipelineError, match=r"npm cannot fetch onnxruntime-web: npm error network; try again, or"):
        runtime.web_runtime()
    assert not runtime.kept().exists()


def test_the_version_is_pinned_in_one_way() -> None:
    wanted = json.loads((runtime.NPM / "package.json").read_text())["dependencies"]
    locked = json.loads((runtime.NPM / "package-lock.json").read_text())["packages"]
    assert wanted == {"onnxruntime-web": runtime.VERSION}
    assert locked["node_modules/onnxruntime-web"]["version"] == runtime.VERSION
    packages = [row for name, row in locked.items() if name]
    assert all(row["integrity"].startswith("sha512-") for row in packages)
    assert not any("resolved" in row for row in packages)  # a person's own registry serves them


@pytest.mark.skipif(not runtime.kept().exists(), reason="onnxruntime-web is not here")
def test_the_kept_files_are_those_whose_digests_are_known() -> None:
    assert {name: sha256(runtime.kept() / name) for name in runtime.DIGESTS} == runtime.DIGESTS
    assert runtime.web_runtime() == runtime.kept()


# ---------------------------------------------------------------------- the command
def refused(capsys: pytest.CaptureFixture[str], *words: str) -> str:
    assert main(["playground", *words]) == 2
    said = capsys.readouterr().err.strip().splitlines()
    assert len(said) == 1
    return said[0]


def test_the_command_refuses_in_one_line(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    assert "unknown case 'reversible'" in refused(capsys, "reversible")
    assert "--one-file takes one case" in refused(capsys, CASE, "thiosulfate_cstr", "--one-file", "x.html")
    assert "needs neither --out nor --port" in refused(capsys, CASE, "--one-file", "x.html", "--port", "0")
    empty = refused(capsys, CASE, "--artifacts", str(tmp_path))
    assert empty.endswith(f"{CASE} has no controller; make some with `loopwright run {CASE}`")
    assert "has no controller" in refused(capsys, "all", "--artifacts", str(tmp_path))
    shutil.copytree(ARTIFACTS / "thiosulfate_cstr", tmp_path / CASE)
    assert f"but plant {CASE!r} has" in refused(capsys, CASE, "--artifacts", str(tmp_path))
    assert "is missing; give the folder `dist`" in refused(capsys, CASE, "--runtime", str(tmp_path))
