"""The library of an FMU: what is compiled, by which compiler, with which headers and which onnxruntime."""

from __future__ import annotations

import importlib.util
import os
import shlex
import shutil
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

from pipeline.errors import HostError
from pipeline.plants.fmu.description import fmpy

HOSTS = Path(__file__).parents[1]
SOURCES = Path(__file__).parent / "sources"
HEADER = "onnxruntime_c_api.h"
COMPILERS = ("cc", "gcc", "clang")
# Also where tools/onnxruntime_c.sh puts the header when it is run in the repository, and where a Debian package does.
PLACES = (HOSTS.parents[1] / "build" / "onnxruntime", Path("/usr/include/onnxruntime"), Path("/usr/local"))
FLAGS = ("-std=c11", "-O2", "-fPIC", "-ffp-contract=off", "-fvisibility=hidden")
LINKED = ("-shared", "-s", "-Wl,-z,defs", "-Wl,-rpath,$ORIGIN", "-lm")


@dataclass(frozen=True, slots=True)
class Toolchain:
    """A C compiler, the folders of the headers of onnxruntime and of FMI, and the library of onnxruntime."""

    compiler: tuple[str, ...]
    includes: tuple[Path, ...]
    library: Path

    @property
    def library_name(self) -> str:
        """The name under which the FMU's library looks for onnxruntime: libonnxruntime.so.1."""
        return ".".join(self.library.name.split(".")[:3])

    def compile(self, source: Path, to: Path) -> None:
        """Compile a file of ``sources`` and link it; HostError with the compiler's first error."""
        headers = [f"-I{HOSTS / 'c'}", *(f"-isystem{folder}" for folder in self.includes)]
        words = [*self.compiler, *FLAGS, *headers, str(source), str(self.library), "-o", str(to), *LINKED]
        done = subprocess.run(words, capture_output=True, text=True, errors="replace", check=False)
        if done.returncode:
            lines = [line for line in done.stderr.splitlines() if line.strip()] or [f"status {done.returncode}"]
            reason = next((line for line in lines if "error" in line), lines[0])
            raise HostError(f"{self.compiler[0]} cannot compile the FMU: {reason.strip()}")


def toolchain(onnxruntime: Path | None = None) -> Toolchain:
    """What this machine has; ``onnxruntime``: a folder with include/onnxruntime_c_api.h.

    Raises HostError, or PlantError for fmpy, naming what is missing.
    """
    package = fmpy()
    if sys.platform != "linux":
        raise HostError(f"an FMU is built on Linux, because the host in C is made for it; this is {sys.platform}")
    headers = Path(str(package.__file__)).parent / "c-code"
    return Toolchain(_compiler(), (_header(onnxruntime), headers), _library())


def _compiler() -> tuple[str, ...]:
    named = shlex.split(os.environ.get("CC", ""))
    for words in [named] if named else [[name] for name in COMPILERS]:
        found = shutil.which(words[0])
        if found:
            return found, *words[1:]
    wanted = f"CC names {named[0]!r}, which is not there" if named else f"none of {', '.join(COMPILERS)} is there"
    raise HostError(f"an FMU is compiled, and no C compiler is installed: {wanted}; apt-get install gcc brings one")


def _header(onnxruntime: Path | None) -> Path:
    for place in PLACES if onnxruntime is None else (onnxruntime,):
        for folder in (place / "include", place / "include" / "onnxruntime", place):
            if (folder / HEADER).is_file():
                return folder
    where = "on this machine" if onnxruntime is None else f"in {onnxruntime} or its include/"
    raise HostError(
        f"an FMU is compiled with {HEADER}, which is not found {where}; unpack a release archive of onnxruntime, or "
        "run tools/onnxruntime_c.sh FOLDER, and name that folder with --onnxruntime FOLDER"
    )


def _library() -> Path:
    """The library of the installed Python package, so that the FMU computes the same bits as Python here."""
    spec = importlib.util.find_spec("onnxruntime")
    folders = list(spec.submodule_search_locations or ()) if spec else []
    found = [path for folder in folders for path in sorted(Path(folder).glob("capi/libonnxruntime.so.*"))]
    if not found:
        raise HostError(
            "the Python package onnxruntime here has no libonnxruntime.so, which goes into the FMU; "
            "pip install --force-reinstall onnxruntime brings it"
        )
    return found[0]
