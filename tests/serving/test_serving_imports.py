"""An embedder installs numpy and onnxruntime: that must be enough, and importing must cost nothing."""

from __future__ import annotations

import subprocess
import sys
import textwrap
from pathlib import Path

import pytest

pytest_plugins = ["small_laws"]
ROOT = Path(__file__).resolve().parents[2]

BLOCKER = """
import sys
from importlib.abc import MetaPathFinder

class Only(MetaPathFinder):
    def find_spec(self, name, path=None, target=None):
        top = name.partition(".")[0]
        ours = top == "loopwright" and not name.startswith("loopwright.pipeline")
        if top not in sys.stdlib_module_names and top not in ALLOWED and not ours:
            raise ModuleNotFoundError(f"No module named {name!r} (this host has only {ALLOWED})", name=name)

sys.meta_path.insert(0, Only())
"""


def run(code: str, allowed: set[str], *arguments: str) -> str:
    """Run ``code`` in a fresh interpreter where only the standard library and ``allowed`` can be imported."""
    text = f"ALLOWED = {allowed!r}\n" + BLOCKER + textwrap.dedent(code)
    # -S keeps site-packages' .pth files (an editable install's finder, say) from running before the blocker.
    done = subprocess.run(
        [sys.executable, "-S", "-W", "error", "-c", text, *arguments],
        capture_output=True,
        text=True,
        cwd=ROOT,
        env={
            "PYTHONPATH": f"{ROOT}/tools/roots:{next(p for p in sys.path if p.endswith('site-packages'))}",
            "PATH": "",
        },
        timeout=60,
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_the_blocker_blocks() -> None:
    with pytest.raises(AssertionError, match="No module named 'torch'"):
        run("import torch", {"numpy", "onnxruntime"})


def test_importing_serving_needs_numpy_alone() -> None:
    run("import loopwright.serving.__main__; assert 'onnxruntime' not in sys.modules", {"numpy"})


def test_a_whole_loop_runs_with_numpy_and_onnxruntime(pi_file: Path) -> None:
    code = """
        import numpy as np
        from loopwright import serving
        controller = serving.Controller(sys.argv[1])
        plant = serving.SimulatedEndpoint(lambda mv: np.array([mv[0] / 50, 300.0]), pv=[0.8, 300.0], mv=40.0)
        loop = serving.ControlLoop(controller, plant, sp=1.0, mv=40.0, mode=serving.Mode.AUTO,
                                   clock=serving.VirtualClock(), guards=())
        report = loop.run(20)
        assert report.scans == 20, report
        tops = {name.partition(".")[0] for name in sys.modules} - set(sys.stdlib_module_names)
        print(sorted(t for t in tops if t not in {"loopwright", "__mp_main__"} and not t.startswith("_")))
        """
    assert run(code, {"numpy", "onnxruntime"}, str(pi_file)).strip() == "['numpy', 'onnxruntime']"


def test_the_command_line_runs_there_too(pi_file: Path) -> None:
    code = "from loopwright.serving.__main__ import main; sys.exit(main(sys.argv[1:]))"
    card = run(code, {"numpy", "onnxruntime"}, "inspect", str(pi_file))
    assert "valve  0 .. 100 %" in card


def test_trust_without_cryptography_says_what_to_install(pi_file: Path) -> None:
    """The runtime needs none of it until a signature is asked for."""
    code = """
        from loopwright.serving import Controller, SignatureError
        Controller(sys.argv[1])
        try:
            Controller(sys.argv[1], trusted=["anna.pub"])
        except SignatureError as error:
            print(error)
        from loopwright.serving.__main__ import main
        print(main(["verify", sys.argv[1], "--key", "anna.pub"]))
        """
    said = run(code, {"numpy", "onnxruntime"}, str(pi_file)).splitlines()
    assert said == ["signatures need the package cryptography: pip install 'loopwright[sign]'", "2"]
