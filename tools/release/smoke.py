"""Try an installed loopwright that has the runtime's packages alone: ``VENV/bin/python smoke.py CONTROLLER``.

Raises AssertionError for the first thing that is not as the README says.
"""

from __future__ import annotations

import re
import subprocess
import sys
from importlib.metadata import requires, version
from importlib.util import find_spec
from pathlib import Path

ABSENT = ("torch", "casadi", "onnx", "scipy", "pandas", "asyncua", "starlette", "mlflow", "yaml", "pip")
EXTRAS = {
    **dict.fromkeys(
        ("new", "run", "check", "results", "simulate", "stress", "certify", "laws", "models", "bounds"), "pipeline"
    ),
    **dict.fromkeys(("plant", "registry"), "pipeline"),
    "loop": "plant",
}


def main(controller: str) -> None:
    """Import, load, step and inspect; each other command names its extra."""
    found = [name for name in ABSENT if find_spec(name)]
    assert not found, f"not only the runtime is here: {found}"
    from loopwright import serving

    place = Path(serving.__file__).parent
    assert place.is_relative_to(sys.prefix), f"serving comes from {place}, not from this environment"
    assert serving.__version__ == version("loopwright")
    loaded = serving.Controller(controller)
    middle = {name: [(s.low + s.high) / 2 for s in getattr(loaded.manifest, name)] for name in ("sp", "pv", "dv", "mv")}
    mv, _, _ = loaded.step(
        sp=middle["sp"], pv=middle["pv"], dv=middle["dv"], mv_applied=middle["mv"], state=loaded.cold_state()
    )
    assert all(s.low <= value <= s.high for s, value in zip(loaded.manifest.mv, mv, strict=True))
    heavy = {"loopwright.pipeline", "onnx", "torch"} & set(sys.modules)
    assert not heavy, f"a step imported {heavy}"

    assert said("--version") == (0, f"loopwright {serving.__version__}\n")
    for told in (said("inspect", controller), said("bench", controller, "--steps", "50", "--loop-steps", "5")):
        assert told[0] == 0, told[1]
    from loopwright.pipeline.commands import COMMANDS

    extras = {command: extra for command in COMMANDS if (extra := lacks(command))}
    assert extras.items() >= EXTRAS.items(), f"not what each command lacks: {extras}"
    always = [line for line in requires("loopwright") or [] if "extra ==" not in line]
    print(
        f"runtime: {loaded.manifest.law} stepped; asks for {', '.join(always)}; {len(extras)} commands name their extra"
    )


def lacks(command: str) -> str | None:
    """The extra that a command asks for in one line; None for one that has what it needs."""
    status, text = said(command, "--help")
    if status == 0:
        assert text.startswith(f"usage: loopwright {command}"), text
        return None
    found = re.fullmatch(
        rf"loopwright {command}: \w+ is not installed; pip install 'loopwright\[(\w+)\]' brings it\n", text
    )
    assert status == 2, text
    assert found, text
    return found[1]


def said(*words: str) -> tuple[int, str]:
    """Exit status and output of ``loopwright WORDS`` of this environment."""
    command = Path(sys.executable).with_name("loopwright")
    done = subprocess.run([command, *words], text=True, timeout=60, stdout=subprocess.PIPE, stderr=subprocess.STDOUT)
    return done.returncode, done.stdout


if __name__ == "__main__":
    main(sys.argv[1])
