"""The content of a controller FMU and its variables, as a folder and a zip file, and its check by the controller."""

from __future__ import annotations

import html
import importlib
import json
import re
import shutil
import zipfile
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from xml.etree import ElementTree
from xml.etree.ElementTree import Element, SubElement

import numpy as np

from loopwright.pipeline.errors import HostError
from loopwright.pipeline.hosts.fmu.compiling import HOSTS, SOURCES, Toolchain
from loopwright.pipeline.plants.fmu.description import described, fmpy
from loopwright.pipeline.plants.fmu.instance import Instance
from loopwright.serving.conformance.steps import answered
from loopwright.serving.controller import Controller
from loopwright.serving.controller_file import file_digest
from loopwright.serving.manifest import Manifest, Signal, What

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


def token_of(controller: Controller) -> str:
    """The guid (FMI 2.0) or instantiationToken (3.0): the first 32 digits of the file's SHA-256."""
    h = controller.sha256
    return f"{{{h[:8]}-{h[8:12]}-{h[12:16]}-{h[16:20]}-{h[20:32]}}}"


def words_of(controller: Controller) -> str:
    """One line: what the controller is."""
    m = controller.manifest
    return in_xml(f"Controller {m.law} of {m.case}, period {m.period_s:g} s, SHA-256 {controller.sha256}")


def description(controller: Controller, identifier: str, fmi: int) -> bytes:
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
    SubElement(root, "CoSimulation", can | (CAN_2 if fmi == 2 else CAN_3))
    units = SubElement(root, "UnitDefinitions")
    for unit in sorted({row.unit for row in rows if row.unit}):
        SubElement(units, "Unit", name=unit)
    categories = SubElement(root, "LogCategories")
    for name, words in LOG.items():
        SubElement(categories, "Category", name=name, description=words)
    SubElement(root, "DefaultExperiment", startTime="0", stepSize=repr(controller.manifest.period_s))
    (_variables_2 if fmi == 2 else _variables_3)(root, rows)
    return _written(root)


def build_description(identifier: str) -> bytes:
    """buildDescription.xml of FMI 3.0: what the sources in the FMU need."""
    root = Element("fmiBuildDescription", fmiVersion="3.0")
    words = "onnxruntime_c_api.h of onnxruntime 1.21 or newer is needed beside FMI's headers"
    build = SubElement(root, "BuildConfiguration", modelIdentifier=identifier, description=words)
    files = SubElement(build, "SourceFileSet", language="C11")
    SubElement(files, "SourceFile", name="fmi3.c")
    SubElement(build, "Library", name="onnxruntime", external="true", description="libonnxruntime.so.1 is in binaries")
    return _written(root)


def page(controller: Controller) -> bytes:
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
        f"</tr>\n{cells}</table>\n<p>The FMU holds onnxruntime's library of one platform. sources/ has what was"
        " compiled for it; the licences are in licenses/.</p>\n</html>\n"
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
ZIP_LEVEL = 1  # compression: onnxruntime's library is nearly all of the file, and 9 saves a tenth of it
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
                made.writestr(entry, path.read_bytes(), compresslevel=ZIP_LEVEL)


def _write_controller(controller: Controller, resources: Path) -> None:
    data = controller.path.read_bytes()
    if file_digest(data) != controller.sha256:
        raise HostError(f"{controller.path} has changed while its FMU was made; run the command again")
    manifest = json.loads(controller.manifest.to_json()) | {"sha256": controller.sha256}
    (resources / "controller.onnx").write_bytes(data)
    (resources / "controller.json").write_text(json.dumps(manifest, indent=1) + "\n", encoding="utf-8")


TIME, FAULT, USE_APPLIED, FIRST = range(4)  # value references; FIRST: of the first signal
BOOLEANS = frozenset({"fault", "use_mv_applied", "use_fresh"})
READ_BACK = "the MV that the plant received over the last period"
NOT_IN_XML = re.compile(r"[^\t\n\r\x20-\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]")


@dataclass(frozen=True, slots=True)
class ScalarVariable:
    """A scalar variable.

    ``group``: sp, pv, dv, mv_applied, mv_start, mv, info, operate, fresh, ahead; time, fault, use_mv_applied or
    use_fresh.
    ``low``, ``high`` and ``start`` are None where there is none.
    """

    name: str
    reference: int
    group: str
    causality: str  # independent, input, output, parameter
    words: str
    unit: str = ""
    low: float | None = None
    high: float | None = None
    start: float | bool | None = None

    @property
    def boolean(self) -> bool:
        """Whether it is a Boolean; else it is real."""
        return self.group in BOOLEANS


def variables_of(m: Manifest) -> list[ScalarVariable]:
    """All variables; HostError where two would have one name, or a name has characters that XML does not have."""
    rows = [
        ScalarVariable("time", TIME, "time", "independent", "simulation time", "s"),
        ScalarVariable("fault", FAULT, "fault", "output", "the last sample was refused: its MV is the one before"),
    ]
    if "mv_applied" in m.inputs:
        words = "whether mv_applied is read once it is set; otherwise its place takes the last mv"
        rows.append(ScalarVariable("use_mv_applied", USE_APPLIED, "use_mv_applied", "parameter", words, start=True))
    groups = [
        ("sp", "input", m.sp if "sp" in m.inputs else (), "set point"),
        ("pv", "input", m.pv if "pv" in m.inputs else (), "process variable"),
        ("dv", "input", m.dv if "dv" in m.inputs else (), "measured disturbance"),
        ("mv_applied", "input", m.mv if "mv_applied" in m.inputs else (), READ_BACK),
        ("mv_start", "parameter", m.mv, "manipulated variable before the first sample"),
        ("mv", "output", m.mv, "manipulated variable"),
    ]
    reference = FIRST
    for group, causality, signals, words in groups:
        for s in signals:
            rows.append(_variable(s, reference, group, causality, words))
            reference += 1
    for name in m.info:
        rows.append(
            ScalarVariable(in_xml(f"info.{name}"), reference, "info", "output", "of the law, for people and alarms")
        )
        reference += 1
    for row in _steering(m):
        rows.append(replace(row, reference=reference))
        reference += 1
    names = [row.name for row in rows]
    twice = next((name for name in names if names.count(name) > 1), None)
    if twice is not None:
        raise HostError(f"two variables of the FMU would be named {twice!r}; an FMU's names must be different")
    return rows


OPERATED_WORDS: Mapping[What, str] = {
    "use": "1: the law takes it into account, 0: it is out",
    "track": "1: the set point is wanted, 0: the range alone",
    "low": "low end of the range in which it may be",
    "high": "high end of the range in which it may be",
    "weight": "times that of its set point; the smaller one gives way",
    "rank": "1: its range is kept before those of 2",
    "max_move": "largest move a period",
    "rest": "where it goes that nothing asks for",
    "rest_use": "1: it goes to its rest, 0: it has none",
    "cost": "per unit and period, beside the other costs",
    "speed": "multiplies the law's",
    "caution": "multiplies the law's",
}


def _steering(m: Manifest) -> Iterator[ScalarVariable]:
    """``operate``, ``fresh`` and ``ahead`` of a law that reads them.

    They stand last: no other variable has another reference.
    """
    for e in m.operate if "operate" in m.inputs else ():
        name, unit = in_xml(f"operate.{e.name}"), "" if e.unit == "-" else in_xml(e.unit)
        words = OPERATED_WORDS[e.what]
        yield ScalarVariable(name, 0, "operate", "parameter", words, unit, e.low, e.high, e.default)
    if "fresh" in m.inputs:
        words = "1: its reading is new and good, 0: it is neither; read where use_fresh is true"
        for s in m.pv:
            yield ScalarVariable(in_xml(f"fresh.{s.name}"), 0, "fresh", "input", words, "", 0.0, 1.0, 1.0)
        words = "whether fresh is read; otherwise all readings are"
        yield ScalarVariable("use_fresh", 0, "use_fresh", "parameter", words, start=False)
    if m.ahead is None or "ahead" not in m.inputs:
        return
    for i in range(1, m.ahead.horizon + 1):
        for a in m.ahead.signals:
            kind, span = "set point" if a.group == "sp" else "disturbance", a.high - a.low
            words = f"this {kind} after {i} periods, minus what it is now"
            name, unit = in_xml(f"ahead.{a.group}.{a.signal}.{i}"), "" if a.unit == "-" else in_xml(a.unit)
            yield ScalarVariable(name, 0, "ahead", "input", words, unit, -span, span, 0.0)


def _variable(s: Signal, reference: int, group: str, causality: str, words: str) -> ScalarVariable:
    if s.values is not None:
        words += f"; allowed: {', '.join(f'{value:g}' for value in s.values)}"
    start = None if causality == "output" else s.middle
    unit = "" if s.unit == "-" else in_xml(s.unit)
    return ScalarVariable(in_xml(f"{group}.{s.name}"), reference, group, causality, words, unit, s.low, s.high, start)


def in_xml(text: str) -> str:
    """A text in one line; HostError where XML cannot hold it."""
    if NOT_IN_XML.search(text):
        raise HostError(f"the name {text!r} has a character that an FMU's description, which is XML, cannot hold")
    return " ".join(text.split())


# ------------------------------- the FMU beside its controller: the same bits in the conformance kit's steps, or no FMU
def check(controller: Controller, fmu: Path, folder: Path) -> int:
    """Play the kit's steps through the FMU, which lies unpacked in ``folder``; how many were compared.

    A refused step must hold the last MV and info and leave the state as it was, which the steps after it show.
    Raises HostError where a number differs by a bit, PlantError where the FMU cannot be loaded or refuses a call.
    """
    rows, period = variables_of(controller.manifest), controller.manifest.period_s
    mv, info = _references(rows, "mv"), _references(rows, "info")
    groups = [name for name in controller.manifest.inputs if name != "state"]
    given_to = [reference for name in groups for reference in _references(rows, name)]
    instance, expected, k = Instance(described(fmu), folder), np.zeros(0), 0
    steps = answered(controller)
    for number, answer in enumerate(steps):
        if answer.given.cold:
            instance.begin(_references(rows, "use_fresh"))
            k = 0
        values = np.concatenate([answer.given.inputs[name] for name in groups])
        instance.step(given_to, values, k * period, period)
        k += 1
        if answer.step is not None:
            expected = np.concatenate([answer.step.mv, answer.step.info])
        found = instance.get([*mv, *info])
        if found.tobytes() != expected.tobytes():
            raise HostError(
                f"the FMU differs from {controller.path} in step {number} of the conformance kit: "
                f"{found.tolist()} instead of {expected.tolist()}; nothing is written"
            )
    return len(steps)


def problems(fmu: Path) -> list[str]:
    """Faults of an FMU by fmpy: its XML against FMI's schema, names, units, the structure of its outputs."""
    fmpy()
    validation = importlib.import_module("fmpy.validation")
    return list(validation.validate_fmu(str(fmu)))


def _references(rows: list[ScalarVariable], group: str) -> list[int]:
    return [row.reference for row in rows if row.group == group]
