"""`make docs` builds the manual without a warning, and what it builds needs no network."""

from __future__ import annotations

import importlib.util
import re
import subprocess
import sys
from pathlib import Path

import pytest
from pages import ROOT

from loopwright.pipeline.laws import LAWS

pytestmark = pytest.mark.skipif(
    importlib.util.find_spec("furo") is None or importlib.util.find_spec("myst_nb") is None,
    reason="sphinx, myst-nb and furo are not installed; `make docs` brings them",
)
LOADED = re.compile(r"""<(?:script|img|link|iframe)\b[^>]*?\b(?:src|href)=["'](https?:|//)[^"']*["'][^>]*>""")


@pytest.fixture(scope="module")
def manual(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The built pages."""
    out = tmp_path_factory.mktemp("manual")
    options = ["-q", "-W", "--keep-going", "-d", str(out / "doctrees"), "-c", "docs", ".", str(out / "html")]
    done = subprocess.run([sys.executable, "-m", "sphinx", *options], cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr[-4000:]
    return out / "html"


def test_the_pages_are_there_and_load_nothing_from_elsewhere(manual: Path) -> None:
    pages = {p.relative_to(manual).as_posix(): p.read_text(encoding="utf-8") for p in manual.rglob("*.html")}
    assert {f"docs/theory/{law}.html" for law in LAWS} <= set(pages)
    assert {"docs/index.html", "README.html", "index.html", "docs/reference/api.html"} <= set(pages)
    assert {name: found[0] for name, text in pages.items() if (found := LOADED.search(text))} == {}
    styles = "".join(p.read_text(encoding="utf-8") for p in manual.rglob("*.css"))
    assert not re.search(r"@import|url\(['\"]?(?:https?:|//)", styles)


def test_formulas_diagrams_and_tables_are_in_the_pages(manual: Path) -> None:
    for law in LAWS:
        text = (manual / "docs" / "theory" / f"{law}.html").read_text(encoding="utf-8")
        assert [part for part in ("<math", "<svg", "closed_loop", '<table class="docutils') if part not in text] == []
    keys = (manual / "docs" / "reference" / "loop_toml.html").read_text(encoding="utf-8")
    assert 0 < keys.index("transfer_s") < keys.index("watchdog_scans") < keys.index("recover_after")
    api = (manual / "docs" / "reference" / "api.html").read_text(encoding="utf-8")
    wanted = ("ControlLoop.set_sp", "Controller.step", "Controller.cold_state")  # the last two are inherited
    assert [name for name in wanted if f'id="loopwright.serving.{name}"' not in api] == []
