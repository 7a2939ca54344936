"""Try an installed loopwright[plant] against a served plant: ``python smoke_plant.py VENV CONTROLLER CASE``.

VENV has the extra, this Python has the pipeline, whose ``loopwright plant serve`` is the other side. Raises
AssertionError.
"""

from __future__ import annotations

import os
import socket
import subprocess
import sys
import tempfile
from pathlib import Path


def main(venv: str, controller: str, case: str) -> None:
    """``loop init``, ``check`` and three scans over OPC UA."""
    loopwright, file = Path(venv).absolute() / "bin/loopwright", Path(controller).absolute()
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        address = f"127.0.0.1:{free.getsockname()[1]}"
    with tempfile.TemporaryDirectory() as folder:
        serve = [
            sys.executable,
            "-m",
            "loopwright.pipeline",
            "plant",
            "serve",
            case,
            "--listen",
            address,
            "--speed",
            "20",
        ]
        server = subprocess.Popen(
            [*serve, "--folder", f"{folder}/server"], stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True
        )
        try:
            assert server.stdout is not None
            assert server.stdout.readline().startswith("serving"), "the plant is not served"
            init = [loopwright, "loop", "init", file, "--endpoint", f"opc.tcp://{address}"]
            for words in (init, [loopwright, "loop", "check"], [loopwright, "loop", "run", "--scans", "3"]):
                done = subprocess.run(words, cwd=folder, env=_bare(), text=True, capture_output=True, timeout=120)
                assert done.returncode == 0, f"{' '.join(map(str, words[1:3]))}: {done.stderr}{done.stdout}"
                if words is init:  # another program may listen at the port that a loop.toml begins with
                    settings = Path(folder) / "loop.toml"
                    settings.write_text(settings.read_text().replace("127.0.0.1:8080", "127.0.0.1:0"))
        finally:
            server.kill()
            server.wait()
        assert (Path(folder) / "loop.journal").exists()
    print(f"plant: loop init, check and three scans of {case} over OPC UA")


def _bare() -> dict[str, str]:
    """The environment without what would let other sources in."""
    return {key: value for key, value in os.environ.items() if not key.startswith("PYTHON")}


if __name__ == "__main__":
    main(*sys.argv[1:])
