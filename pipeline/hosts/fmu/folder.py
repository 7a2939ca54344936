"""The content of a controller FMU, as a folder and a zip file, and its check by the steps that it must give."""

from __future__ import annotations

import html
import importlib
import json
import re
import shutil
import zipfile
from pathlib import Path
from xml.etree import ElementTree
from xml.etree.ElementTree import Element, SubElement

import numpy as np

from loopwright.pipeline.errors import HostError
from loopwright.pipeline.files import write_text
from loopwright.pipeline.hosts.fmu.compiling import Toolchain
from loopwright.pipeline.hosts.fmu.law_sources import LAW, sources_of
from loopwright.pipeline.hosts.fmu.variables import ScalarVariable, in_xml, variables_of
from loopwright.pipeline.plants.fmu.description import described, fmpy
from loopwright.pipeline.plants.fmu.instance import Instance
from loopwright.serving.conformance.steps import StepResult
from loopwright.serving.controller import Controller
from loopwright.serving.controller_file import file_digest

LOG = {
    "logStatusError": "why a call failed",
    "logStatusWarning": "why a sample was refused; only with logging on",
}
CAN_2 = {"canGetAndSetFMUstate": "true", "canSerializeFMUstate": "true", "canNotUseMemoryManagementFunctions": "true"}
CAN_3 = {"canGetAndSetFMUState": "true", "canSerializeFMUState": "true"}
SAMPLING = """<p>The controller samples on its own grid: at the start time and every {period:g} s after it. A sample
takes the inputs as they stand in the communication step that holds it (its start included, its end not), and its MV is
there at the end of that step. Between samples all outputs are held. A step longer than the period takes several
samples of the same inputs. Steps need be no multiple of the period.</p>
<p>A sample with an input that is not finite, or whose MV may not be used, is refused: <code>fault</code> is true, the
last MV is held and the law's state stays as it was, until a sample is accepted again.</p>"""
APPLIED = """<p><code>mv_applied</code> is the MV that the plant received. Until it is set in a step, and wherever the
parameter <code>use_mv_applied</code> is false, the FMU's own last MV takes its place. A tool that writes a value, as 0,
to an input without a connection needs <code>use_mv_applied</code> = false.</p>"""


OPERATED = """<p><code>operate.NAME</code> is what operators may change: a tunable parameter, which may be set before
any communication step. A value outside its range is refused where it is set, a low end above its high one at the end
of the initialization and at the next step. <code>fresh.NAME</code> is 1 for a process variable whose reading is new
and good, 0 for one that is neither; these inputs are read where the parameter <code>use_fresh</code> is true.</p>"""
KNOWN = """<p><code>ahead.sp.NAME.I</code> and <code>ahead.dv.NAME.I</code> say by how much a set point or a measured
disturbance will differ from its present value in I periods. Inputs that nothing is connected to stay 0: it stays as it
is. A value to come outside its range is refused, as a sample that is not finite.</p>"""


ONNXRUNTIMES = " It needs onnxruntime's library, which lies beside it; its licences are in licenses/."


def token_of(controller: Controller) -> str:
    """The guid (FMI 2.0) or instantiationToken (3.0): the first 32 digits of the file's SHA-256."""
    h = controller.sha256
    return f"{{{h[:8]}-{h[8:12]}-{h[12:16]}-{h[16:20]}-{h[20:32]}}}"


def words_of(controller: Controller) -> str:
    """One line: what the controller is."""
    m = controller.manifest
    return in_xml(f"Controller {m.law} of {m.case}, period {m.period_s:g} s, SHA-256 {controller.sha256}")


def description(controller: Controller, identifier: str, fmi: int, tools: Toolchain) -> bytes:
    """modelDescription.xml for FMI 2 or 3; HostError as of ``variables_of``."""
    rows = variables_of(controller.manifest)
    root = Element("fmiModelDescription", fmiVersion=f"{fmi}.0", modelName=identifier)
    root.set("guid" if fmi == 2 else "instantiationToken", token_of(controller))
    root.set("description", words_of(controller))
    root.set("generationTool", "Loopwright")
    root.set("variableNamingConvention", "flat")
    if fmi == 2:
        root.set("numberOfEventIndicators", "0")
    can = {"modelIdentifier": identifier, "canHandleVariableCommunicationStepSize": "true"}
    simulated = SubElement(root, "CoSimulation", can | (CAN_2 if fmi == 2 else CAN_3))
    if fmi == 2:  # FMI 3.0 has buildDescription.xml
        sources = SubElement(simulated, "SourceFiles")
        for name in compiled(fmi, tools):
            SubElement(sources, "File", name=name)
    units = SubElement(root, "UnitDefinitions")
    for unit in sorted({row.unit for row in rows if row.unit}):
        SubElement(units, "Unit", name=unit)
    categories = SubElement(root, "LogCategories")
    for name, words in LOG.items():
        SubElement(categories, "Category", name=name, description=words)
    SubElement(root, "DefaultExperiment", startTime="0", stepSize=repr(controller.manifest.period_s))
    (_variables_2 if fmi == 2 else _variables_3)(root, rows)
    return _written(root)


PLAIN_WORDS = "A C compiler and FMI's headers suffice; -ffp-contract=off gives the same bits everywhere"
HOST_WORDS = "onnxruntime_c_api.h of onnxruntime 1.21 or newer is needed beside FMI's headers"


def build_description(identifier: str, tools: Toolchain) -> bytes:
    """buildDescription.xml, of FMI 3.0 and read for 2.0 too: what the sources in the FMU need."""
    plain, fmi = tools.library is None, 3
    root = Element("fmiBuildDescription", fmiVersion="3.0")
    words = PLAIN_WORDS if plain else HOST_WORDS
    build = SubElement(root, "BuildConfiguration", modelIdentifier=identifier, description=words)
    options = {"compiler": "gcc", "compilerOptions": "-ffp-contract=off"}
    files = SubElement(build, "SourceFileSet", {"language": "C11"} | (options if plain else {}))
    for name in compiled(fmi, tools):
        SubElement(files, "SourceFile", name=name)
    if not plain:
        words = "libonnxruntime.so.1 is in binaries"
        SubElement(build, "Library", name="onnxruntime", external="true", description=words)
    return _written(root)


def compiled(fmi: int, tools: Toolchain) -> list[str]:
    """The files of ``sources`` that are compiled; they include the others."""
    return [f"fmi{fmi}.c", *([f"{LAW}.c"] if tools.library is None else [])]


def page(controller: Controller, tools: Toolchain) -> bytes:
    """documentation/index.html."""
    m, rows = controller.manifest, variables_of(controller.manifest)
    cells = "".join(
        f"<tr><td>{html.escape(r.name)}</td><td>{r.causality}</td><td>{html.escape(r.unit)}</td>"
        f"<td>{'' if r.low is None else f'{r.low:g} to {r.high:g}'}</td>"
        f"<td>{'' if r.start is None else f'{r.start:g}'}</td><td>{html.escape(r.words)}</td></tr>\n"
        for r in rows
    )
    title = html.escape(words_of(controller))
    further = [
        words for name, words in (("mv_applied", APPLIED), ("operate", OPERATED), ("ahead", KNOWN)) if name in m.inputs
    ]
    return (
        f'<!DOCTYPE html>\n<html lang="en"><meta charset="utf-8"><title>{title}</title>\n<h1>{title}</h1>\n'
        f"{SAMPLING.format(period=m.period_s)}\n{chr(10).join(further)}\n"
        "<table>\n<tr><th>variable</th><th>causality</th><th>unit</th><th>range</th><th>start</th><th>what it is</th>"
        f"</tr>\n{cells}</table>\n<p>The library is of one platform; sources/ has what was compiled for it."
        f"{'' if tools.library is None else ONNXRUNTIMES}</p>\n</html>\n"
    ).encode()


# ---------------------------------------------------------------------- variables in XML
def _variables_2(root: Element, rows: list[ScalarVariable]) -> None:
    parent = SubElement(root, "ModelVariables")
    shown = [row for row in rows if row.causality != "independent"]  # FMI 2.0 needs none, and no tool a second time
    for row in shown:
        element = SubElement(parent, "ScalarVariable", _common(row))
        SubElement(element, "Boolean" if row.boolean else "Real", _numbers(row))
    index = {row.reference: str(k) for k, row in enumerate(shown, 1)}
    structure = SubElement(root, "ModelStructure")
    outputs, initial = SubElement(structure, "Outputs"), SubElement(structure, "InitialUnknowns")
    for row in shown:
        if row.causality == "output":
            SubElement(outputs, "Unknown", index=index[row.reference], dependencies="")
            before = [index[r.reference] for r in _start_of(row, rows)]
            SubElement(initial, "Unknown", index=index[row.reference], dependencies=" ".join(before))


def _variables_3(root: Element, rows: list[ScalarVariable]) -> None:
    parent, structure = SubElement(root, "ModelVariables"), SubElement(root, "ModelStructure")
    for row in rows:
        SubElement(parent, "Boolean" if row.boolean else "Float64", _common(row) | _numbers(row))
    outputs = [row for row in rows if row.causality == "output"]
    for row in outputs:
        SubElement(structure, "Output", valueReference=str(row.reference), dependencies="")
    for row in outputs:
        before = " ".join(str(r.reference) for r in _start_of(row, rows))
        SubElement(structure, "InitialUnknown", valueReference=str(row.reference), dependencies=before)


def _start_of(output: ScalarVariable, rows: list[ScalarVariable]) -> list[ScalarVariable]:
    """The parameter that an output begins with, if it is an MV."""
    name = output.name.removeprefix("mv.")
    return [r for r in rows if output.group == "mv" and r.group == "mv_start" and r.name == f"mv_start.{name}"]


def _common(row: ScalarVariable) -> dict[str, str]:
    varies = {"output": "discrete", "parameter": "fixed"}.get(row.causality, "continuous")
    varies = {"operate": "tunable", "fresh": "discrete", "ahead": "discrete"}.get(
        row.group, varies
    )  # a tool interpolates no flag
    found = {"name": row.name, "valueReference": str(row.reference), "causality": row.causality, "variability": varies}
    return found | {"description": row.words} | ({"initial": "calculated"} if row.causality == "output" else {})


def _numbers(row: ScalarVariable) -> dict[str, str]:
    found = {"unit": row.unit} if row.unit else {}
    if row.low is not None and row.high is not None:
        found |= {"min": repr(row.low), "max": repr(row.high)}
    if row.start is not None:
        found["start"] = str(row.start).lower() if row.boolean else repr(row.start)
    return found


def _written(root: Element) -> bytes:
    ElementTree.indent(root)
    return ElementTree.tostring(root, encoding="UTF-8", xml_declaration=True) + b"\n"


# ----------------------------------------------------------------------------------------------- the content of an FMU
MADE = (1980, 1, 1, 0, 0, 0)  # the time of every entry: the same controller gives the same bytes
ZIP_LEVEL = 9  # compression: an FMU of plain C is small, and one with onnxruntime is written in seconds all the same
LICENCES = ("LICENSE", "ThirdPartyNotices.txt")


def identifier_of(path: Path) -> str:
    """The FMU's modelIdentifier, a C identifier: the name of the controller file with '_' for what may not stand."""
    name = re.sub(r"[^A-Za-z0-9_]", "_", path.stem)
    return name if name[:1].isalpha() else f"controller_{name}"


def write_folder(controller: Controller, folder: Path, fmi: int, tools: Toolchain) -> str:
    """Write all files of an FMU (``fmi`` 2 or 3) into an empty folder; its modelIdentifier.

    Raises HostError where the controller file has changed since it was loaded, or does not compile; ExportError where
    its law has no plain C.
    """
    identifier = identifier_of(controller.path)
    package = fmpy()
    platform = package.platform if fmi == 2 else package.platform_tuple
    binaries, resources, sources, pages = (
        folder / "binaries" / platform, folder / "resources", folder / "sources", folder / "documentation",
    )  # fmt: skip
    for made in (binaries, resources, sources, pages):
        made.mkdir(parents=True)
    (folder / "modelDescription.xml").write_bytes(description(controller, identifier, fmi, tools))
    (pages / "index.html").write_bytes(page(controller, tools))
    _write_controller(controller, resources, with_graph=tools.library is not None)
    for name, text in sources_of(controller, fmi, tools).items():
        write_text(sources / name, text)
    if fmi == 3:
        (sources / "buildDescription.xml").write_bytes(build_description(identifier, tools))
    tools.compile([sources / name for name in compiled(fmi, tools)], binaries / f"{identifier}.so")
    if tools.library is None:
        return identifier
    shutil.copyfile(tools.library, binaries / tools.library_name)
    (pages / "licenses").mkdir()
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
                made.writestr(entry, path.read_bytes(), compresslevel=ZIP_LEVEL)


def _write_controller(controller: Controller, resources: Path, *, with_graph: bool) -> None:
    data = controller.path.read_bytes()
    if file_digest(data) != controller.sha256:
        raise HostError(f"{controller.path} has changed while its FMU was made; run the command again")
    manifest = json.loads(controller.manifest.to_json()) | {"sha256": controller.sha256}
    if with_graph:
        (resources / "controller.onnx").write_bytes(data)
    (resources / "controller.json").write_text(json.dumps(manifest, indent=1) + "\n", encoding="utf-8")


# ------------------------------- the FMU beside its controller: the same bits in the conformance kit's steps, or no FMU
def check(controller: Controller, fmu: Path, folder: Path, steps: list[StepResult]) -> int:
    """Play steps through the FMU, which lies unpacked in ``folder``, each from its given state; how many were compared.

    A refused step must hold the last MV and info and leave the state as it was. Raises HostError where a number differs
    by a bit, PlantError where the FMU cannot be loaded or refuses a call.
    """
    rows, period = variables_of(controller.manifest), controller.manifest.period_s
    mv, info = _references(rows, "mv"), _references(rows, "info")
    groups = [name for name in controller.manifest.inputs if name != "state"]
    given_to = [reference for name in groups for reference in _references(rows, name)]
    instance, expected, k = Instance(described(fmu), folder), np.zeros(0), 0
    n_state = 8 * controller.manifest.n_state  # bytes, which stand last in a saved state
    for number, answer in enumerate(steps):
        if answer.given.cold:
            instance.begin(_references(rows, "use_fresh"))
            k = 0
        instance.read(instance.written()[: len(instance.written()) - n_state] + answer.state.tobytes())
        values = np.concatenate([answer.given.inputs[name] for name in groups])
        instance.step(given_to, values, k * period, period)
        k += 1
        if answer.step is not None:
            expected = np.concatenate([answer.step.mv, answer.step.info])
        state = answer.state if answer.step is None else answer.step.state
        found, after = instance.get([*mv, *info]), instance.written()
        if found.tobytes() != expected.tobytes() or after[len(after) - n_state :] != state.tobytes():
            raise HostError(
                f"the FMU differs from {controller.path} in step {number} of the conformance kit: "
                f"{found.tolist()} instead of {expected.tolist()}, or its state; nothing is written"
            )
    return len(steps)


def problems(fmu: Path) -> list[str]:
    """Faults of an FMU by fmpy: its XML against FMI's schema, names, units, the structure of its outputs."""
    fmpy()
    validation = importlib.import_module("fmpy.validation")
    return list(validation.validate_fmu(str(fmu)))


def _references(rows: list[ScalarVariable], group: str) -> list[int]:
    return [row.reference for row in rows if row.group == group]
