"""Code of the manual runs: Python as it stands, commands through the real parsers, settings through the real readers.

A block that does not run here says why in a comment right above it: ``<!-- not run: REASON -->``, or
``<!-- run by: FILE -->`` with the test that runs it. ``test_manual_shell_blocks.py`` runs the shell blocks without a
mark, and of those with ``<!-- run in part: PIECE, PIECE: REASON -->`` the commands that hold a PIECE.
"""

from __future__ import annotations

import os
import re
import shlex
import subprocess
import sys
import tomllib
import types
from pathlib import Path

import pytest
import yaml
from manual.commands import parser_of
from pages import FENCE, PAGES, ROOT, Block, blocks
from stated import assert_stated

from loopwright.pipeline.commands import COMMANDS
from loopwright.pipeline.config.exports import ExportParams
from loopwright.pipeline.config.known import Known
from loopwright.pipeline.config.params import CaseParams, ControllerParams, ModelParams, RecordParams, parse
from loopwright.pipeline.excitation import EXCITATIONS
from loopwright.pipeline.laws import LAWS
from loopwright.pipeline.models import MODELS
from loopwright.serving.station.settings import Settings

LANGUAGES = {"python", "sh", "bash", "yaml", "toml", "text", "", "{generated}", "{diagram}", "{toctree}", "{eval-rst}"}
ALL = [block for page in PAGES for block in blocks(page)]
# Programs that a page may call, beside `loopwright` and Python: what they are given is for a person to see.
OTHERS = {"cd", "git", "source", "export", "dask", "docker", "cp", "mlflow", "dvc", "curl", "openssl"}
OTHERS |= {"for", "do", "done", "sleep"}
OTHERS |= {"npm", "node", "cmake", "build/host", "build/main"}


def of(*languages: str) -> list[Block]:
    return [block for block in ALL if block.language in languages]


def test_each_block_has_a_language_that_is_tested() -> None:
    assert {block.where: block.language for block in ALL if block.language not in LANGUAGES} == {}


def test_who_does_not_run_says_why() -> None:
    for block in ALL:
        if block.mark:
            kind, words = block.mark
            assert len(words) > 10, block.where
            if kind == "run by":
                assert block.page.name in (ROOT / words).read_text(encoding="utf-8"), block.where
            for named in re.findall(r"\btests/[\w/.]*\w", words):
                assert (ROOT / named).exists(), f"{block.where}: no {named}"


@pytest.mark.parametrize("page", PAGES, ids=lambda p: p.relative_to(ROOT).as_posix())
def test_no_code_stands_without_a_fence(page: Path) -> None:
    """A block that is only set in would be tested by nothing; a list's own lines may be set in."""
    before, found = "", []
    for line in FENCE.sub("", page.read_text(encoding="utf-8")).splitlines():
        if line.startswith("    ") and not before.startswith(("    ", "- ", "  ", "* ")) and not _numbered(before):
            found.append(line)
        before = line or (before if before.startswith(("- ", "* ", "  ")) or _numbered(before) else "")
    assert found == []


def _numbered(line: str) -> bool:
    return re.match(r"\d+\. ", line) is not None


def pages_with_python() -> list[Path]:
    return [page for page in PAGES if any(b.language == "python" and not b.mark for b in blocks(page))]


@pytest.mark.parametrize("page", pages_with_python(), ids=lambda p: p.relative_to(ROOT).as_posix())
def test_the_python_of_a_page_runs(page: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """All blocks in their order, as one program; in a tutorial, a block below the name of a file is that file."""
    for name in ("artifacts", "params.yaml"):
        (tmp_path / name).symlink_to(ROOT / name)
    found = [block for block in blocks(page) if block.language == "python" and not block.mark]
    if page.parent.name == "tutorials":
        text = page.read_text(encoding="utf-8")
        lines = text.splitlines()
        for block in found:
            above = " ".join(lines[block.line - 4 : block.line - 1])
            name = re.findall(r"`(\w+\.py)`", above)[0]
            (tmp_path / name).write_text(block.text, encoding="utf-8")
            printed = _run(name, tmp_path)
            after = text[text.index(block.text) + len(block.text) :].split("\n## ")[0]
            stated = re.findall(r"[Ii]t prints `([^`]+)`", above)
            for shown in [*stated, *re.findall(r"It prints:?\s+```text\n(.*?)```", after, re.DOTALL)]:
                assert_stated(shown, printed, block.where)
        return
    module = types.ModuleType("page")
    monkeypatch.setitem(sys.modules, "page", module)
    monkeypatch.chdir(tmp_path)
    exec(compile("\n".join(block.text for block in found), str(page), "exec"), module.__dict__)


def _run(file: str, folder: Path) -> str:
    environment = {**os.environ, "PYTHONPATH": str(ROOT / "tools/roots")}
    done = subprocess.run([sys.executable, file], cwd=folder, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, f"{file}: {done.stderr[-2000:]}"
    return done.stdout


def commands_of(block: Block) -> list[list[str]]:
    """The words of each command of a shell block; comments and continued lines as a shell has them."""
    lines = block.text.replace("\\\n", " ").splitlines()
    return [found for line in lines for part in line.split(" | ") if (found := shlex.split(part, comments=True))]


@pytest.mark.parametrize("block", of("sh", "bash"), ids=lambda b: b.where)
def test_commands_are_those_that_there_are(block: Block, capsys: pytest.CaptureFixture[str]) -> None:
    for found in commands_of(block):
        while found and re.fullmatch(r"[A-Z_]+=.*", found[0]):
            found = found[1:]
        program, *rest = found or ["export"]
        if program == "loopwright":
            assert rest[0] in COMMANDS, block.where
            try:
                parser_of(rest[0]).parse_args([w for w in rest[1:] if w not in {"...", "&"}])
            except SystemExit:
                pytest.fail(f"{block.where}: {shlex.join(found)}: {capsys.readouterr().err}")
        elif program in {"python", "python3"}:
            _check_python(rest, block)
        elif program == "make":
            targets = set(re.findall(r"^([a-z]+):", (ROOT / "Makefile").read_text(encoding="utf-8"), re.MULTILINE))
            assert {w for w in rest if "=" not in w} <= targets, block.where
        elif program == "pip":
            assert rest[0] == "install", block.where
            extras = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
            for asked in re.findall(r"\[([\w,]+)\]", " ".join(rest)):
                assert set(asked.split(",")) <= set(extras["optional-dependencies"]), block.where
        else:
            assert program in OTHERS, f"{block.where}: {program} is not known; add it, or say why it does not run"


def _check_python(rest: list[str], block: Block) -> None:
    if rest[0] == "-m":
        assert rest[1] in {
            "venv",
            "loopwright.serving",
            "loopwright.pipeline.engine.start",
            "loopwright.pipeline.playground.web_runtime",
        }, block.where
    else:
        made = {name for b in blocks(block.page) for name in re.findall(r"`(\w+\.py)`", b.page.read_text("utf-8"))}
        assert (ROOT / rest[0]).exists() or rest[0] in made, f"{block.where}: no {rest[0]}"


@pytest.mark.parametrize("block", of("yaml"), ids=lambda b: b.where)
def test_yaml_is_what_params_yaml_takes(block: Block) -> None:
    if block.mark:
        return
    tree = yaml.safe_load(block.text)
    readers = {"exports": ExportParams, "cases": CaseParams, "models": ModelParams}
    assert set(tree) <= {*readers, "records", "controllers", "plants"}, block.where
    for entry in tree.pop("plants", {}).values():  # a part of a section, whose signals `new` writes
        assert set(entry) == {"known"}, block.where
        assert all(parse(Known, one, block.where) for one in entry["known"])
    for section, entries in tree.items():
        for name, entry in entries.items():
            if section in readers:
                parse(readers[section], entry, name)
            cls = {"records": RecordParams, "controllers": ControllerParams}.get(section)
            if cls is not None:
                assert {"case"} <= set(entry), block.where
            page = block.page.read_text(encoding="utf-8")
            for part in entry.get("parts", {}).values():
                assert part["kind"] in MODELS or f'"{part["kind"]}"' in page, block.where
            for key, known in (("law", LAWS), ("kind", EXCITATIONS)):
                word = entry.get(key)
                assert word is None or word in known or f'"{word}"' in page, block.where


@pytest.mark.parametrize("block", of("toml"), ids=lambda b: b.where)
def test_toml_is_what_loop_toml_takes(block: Block) -> None:
    """A block shows some keys; those that a loop.toml must have stand beside them here."""
    if block.mark:
        return
    server = {"endpoint": "opc.tcp://127.0.0.1:4840", "security": "None", "insecure": True}
    needed = {"controller": "pid.onnx", "server": server, "nodes": {"pv": {}, "mv": {}}}
    parse(Settings, needed | tomllib.loads(block.text), block.where)
