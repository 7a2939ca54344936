"""The content of a controller FMU, as a folder and as the zip file that tools read."""

from __future__ import annotations

import json
import re
import shutil
import zipfile
from pathlib import Path

from loopwright.pipeline.errors import HostError
from loopwright.pipeline.hosts.fmu.compiling import HOSTS, SOURCES, Toolchain
from loopwright.pipeline.hosts.fmu.description import build_description, description, page
from loopwright.pipeline.plants.fmu.description import fmpy
from loopwright.serving.controller import Controller
from loopwright.serving.controller_file import file_digest

MADE = (1980, 1, 1, 0, 0, 0)  # the time of every entry: the same controller gives the same bytes
QUICK = 1  # compression: onnxruntime's library is nearly all of the file, and 9 saves a tenth of it
LICENCES = ("LICENSE", "ThirdPartyNotices.txt")


def identifier_of(path: Path) -> str:
    """The FMU's modelIdentifier, a C identifier: the name of the controller file with '_' for what may not stand."""
    name = re.sub(r"[^A-Za-z0-9_]", "_", path.stem)
    return name if name[:1].isalpha() else f"controller_{name}"


def write_folder(controller: Controller, folder: Path, fmi: int, tools: Toolchain) -> str:
    """Write all files of an FMU (``fmi`` 2 or 3) into an empty folder; its modelIdentifier.

    Raises HostError where the controller file has changed since it was loaded, or does not compile.
    """
    identifier = identifier_of(controller.path)
    package = fmpy()
    platform = package.platform if fmi == 2 else package.platform_tuple
    binaries, resources, sources, pages = (
        folder / "binaries" / platform, folder / "resources", folder / "sources", folder / "documentation",
    )  # fmt: skip
    for made in (binaries, resources, sources, pages / "licenses"):
        made.mkdir(parents=True)
    (folder / "modelDescription.xml").write_bytes(description(controller, identifier, fmi))
    (pages / "index.html").write_bytes(page(controller))
    _write_controller(controller, resources)
    for source in [HOSTS / "c" / "host.c", SOURCES / "instance.c", *sorted(SOURCES.glob(f"fmi{fmi}*.c"))]:
        shutil.copyfile(source, sources / source.name)
    if fmi == 3:
        (sources / "buildDescription.xml").write_bytes(build_description(identifier))
    tools.compile(SOURCES / f"fmi{fmi}.c", binaries / f"{identifier}.so")
    shutil.copyfile(tools.library, binaries / tools.library_name)
    for name in LICENCES:
        licence = tools.library.parents[1] / name
        if licence.is_file():
            shutil.copyfile(licence, pages / "licenses" / f"onnxruntime-{licence.stem}.txt")
    return identifier


def pack(folder: Path, to: Path) -> None:
    """Zip a folder into an FMU; the same folder gives the same bytes."""
    with zipfile.ZipFile(to, "w") as made:
        for path in sorted(folder.rglob("*")):
            if path.is_file():
                entry = zipfile.ZipInfo(path.relative_to(folder).as_posix(), MADE)
                entry.compress_type = zipfile.ZIP_DEFLATED
                entry.external_attr = (0o755 if path.name.startswith("lib") or path.suffix == ".so" else 0o644) << 16
                made.writestr(entry, path.read_bytes(), compresslevel=QUICK)


def _write_controller(controller: Controller, resources: Path) -> None:
    data = controller.path.read_bytes()
    if file_digest(data) != controller.sha256:
        raise HostError(f"{controller.path} has changed while its FMU was made; run the command again")
    manifest = json.loads(controller.manifest.to_json()) | {"sha256": controller.sha256}
    (resources / "controller.onnx").write_bytes(data)
    (resources / "controller.json").write_text(json.dumps(manifest, indent=1) + "\n", encoding="utf-8")
