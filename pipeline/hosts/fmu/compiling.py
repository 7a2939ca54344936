"""The library of an FMU: by which compiler, with which headers, and with onnxruntime where it is wanted."""

from __future__ import annotations

import importlib.util
import re
import sys
from dataclasses import dataclass
from pathlib import Path

from loopwright.pipeline.errors import HostError
from loopwright.pipeline.export.plain_code.c_compiler import CCompiler
from loopwright.pipeline.plants.fmu.description import fmpy

HOSTS = Path(__file__).parents[1]
SOURCES = Path(__file__).parent / "sources"
HEADER = "onnxruntime_c_api.h"
# onnxruntime's own, of release 1.21.0 as in Debian 13; MIT, its licence lies beside it. The Python package has none.
# Any library that is no older serves it, and the host in C uses nothing newer, so it need not follow each release.
SHIPPED = HOSTS / "c" / "onnxruntime"
SHIPPED_SHA256 = "7783e9664bdb0b1b36145b5c8587dd1bc9a399aa000edf2e3dd03003cafc6882"
FLAGS = ("-std=c11", "-O2", "-fPIC", "-ffp-contract=off", "-fvisibility=hidden")
LINKED = ("-shared", "-s", "-Wl,-z,defs", "-Wl,-rpath,$ORIGIN", "-lm")


@dataclass(frozen=True, slots=True)
class Toolchain:
    """A C compiler and the folders of headers; ``library`` is that of onnxruntime, None: plain C computes the law."""

    compiler: CCompiler
    includes: tuple[Path, ...]
    library: Path | None

    @property
    def library_name(self) -> str:
        """The name under which the FMU's library looks for onnxruntime, as libonnxruntime.so.1; empty without it."""
        return "" if self.library is None else ".".join(self.library.name.split(".")[:3])

    def compile(self, sources: list[Path], to: Path) -> None:
        """Compile files of ``sources`` and link them; HostError with the compiler's first error."""
        headers = [f"-isystem{folder}" for folder in self.includes]
        parts = [*sources, *([] if self.library is None else [self.library])]
        words = [*FLAGS, *headers, *map(str, parts), "-o", str(to), *LINKED]
        self.compiler.compile(words, "the FMU")


def toolchain(*, onnxruntime: bool = False) -> Toolchain:
    """The tools of this machine, for an FMU of plain C or for one that holds ``onnxruntime``.

    Raises HostError, or PlantError for fmpy, naming what is missing.
    """
    package = fmpy()
    if sys.platform != "linux":
        raise HostError(f"an FMU is built on Linux, whose libraries its options make; this is {sys.platform}")
    headers = Path(str(package.__file__)).parent / "c-code"
    compiler = CCompiler.here()
    if not onnxruntime:
        return Toolchain(compiler, (headers,), None)
    library = _library()
    _require_no_older(library, SHIPPED / HEADER)
    return Toolchain(compiler, (SHIPPED, headers), library)


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


def _require_no_older(library: Path, header: Path) -> None:
    """A library serves the headers of its own release and of those before it."""
    release = re.search(r"\.so\.(\d+)\.(\d+)", library.name)
    wanted = re.search(r"#define ORT_API_VERSION (\d+)", header.read_text(encoding="utf-8", errors="replace"))
    if release and wanted and (int(release[1]), int(release[2])) < (1, int(wanted[1])):
        raise HostError(
            f"onnxruntime here is {release[1]}.{release[2]}, older than its header of 1.{wanted[1]}; "
            f"pip install 'onnxruntime>=1.{wanted[1]}' brings one that an FMU can hold"
        )
