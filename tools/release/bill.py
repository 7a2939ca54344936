"""Write the bill of materials and the licences: ``python bill.py CLOSURE ENVIRONMENT FOLDER``.

CLOSURE is what closure.py prints, ENVIRONMENT the bill that cyclonedx-py makes of the same Python. FOLDER gets
loopwright-VERSION.cdx.json (CycloneDX 1.6): what each extra brings, what lies in the wheel itself, and what npm fetches
for ``loopwright playground``; and loopwright-VERSION-licences.md, the same for people, copyleft first.
"""

from __future__ import annotations

import base64
import hashlib
import json
import re
import sys
from pathlib import Path
from typing import Any

from cyclonedx.schema import SchemaVersion
from cyclonedx.validation.json import JsonStrictValidator
from licences import BSD, Kind, UnclearError, has_choice, kind, licence, reviewed_of

ROOT = Path(__file__).parents[2]
NAME, OURS = "loopwright", "Apache-2.0 AND MIT"
STATIC, C_HEADER = ROOT / "serving/page/static", ROOT / "pipeline/hosts/c/onnxruntime"
ON_THE_PAGE = "onnxruntime-web"  # which the page loads
NPM_LOCK, PLAYGROUND = ROOT / "pipeline/playground/npm/package-lock.json", "npm, for loopwright playground"
BROUGHT, LIES_IN = "loopwright:brought-by", "loopwright:lies-in"
ABOUT = """What pip brings with loopwright {version} and each of its extras, in the versions of constraints.txt{python}.
"runtime" is `pip install loopwright` alone. The page's uPlot and onnxruntime's C header lie in
loopwright's own wheel. `loopwright playground` has npm fetch onnxruntime-web and the packages that it names, and copies
two files of onnxruntime-web into each page that it writes.

The list goes by what each package states of itself. A package may bundle libraries, whose licences lie in its own
folder. On Linux PyTorch can come with NVIDIA's CUDA packages (`nvidia-*`), which are proprietary and not listed:
PyTorch's CPU wheels do without them.
"""
WORDS = {
    Kind.WEAK: "of the package's own files or library",
    Kind.STRONG: "of the whole program",
    Kind.OTHER: "neither copyleft nor permissive: read it",
}


def rows(closure: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Each package of closure.py with its licence and the kind of it. Raises UnclearError, which names all that are."""
    reviewed = reviewed_of(closure)
    found, unclear = [], []
    for package in closure:
        try:
            expression = licence(package, reviewed)
            found.append({**package, "expression": expression, "kind": kind(expression)})
        except UnclearError as error:
            unclear.append(str(error))
    if unclear:
        raise UnclearError("; ".join(unclear))
    return found


def fetched() -> list[dict[str, Any]]:
    """The packages that npm fetches for the playground, as its lock names them. Raises UnclearError."""
    found, unclear = [], []
    for path, row in sorted(json.loads(NPM_LOCK.read_text(encoding="utf-8"))["packages"].items()):
        if not path:  # the lock's own
            continue
        name, expression = path.rpartition("node_modules/")[2], row.get("license", "")
        try:
            found.append({**row, "name": name, "expression": expression, "kind": kind(expression), "by": [PLAYGROUND]})
        except UnclearError as error:
            unclear.append(f"{name} {row['version']}: {error}")
    if unclear:
        raise UnclearError("; ".join(unclear))
    return found


def _npm_component(package: dict[str, Any]) -> dict[str, Any]:
    algorithm, digest = package["integrity"].split("-", 1)
    return {
        "bom-ref": _npm_url(package),
        "type": "library",
        "name": package["name"],
        "version": package["version"],
        "purl": _npm_url(package),
        "licenses": [{"expression": package["expression"]}],
        "hashes": [{"alg": algorithm.upper().replace("SHA", "SHA-"), "content": base64.b64decode(digest).hex()}],
        "properties": [{"name": BROUGHT, "value": PLAYGROUND}],
    }


def _npm_url(package: dict[str, Any]) -> str:
    return f"pkg:npm/{package['name'].replace('@', '%40')}@{package['version']}"


def bill(
    packages: list[dict[str, Any]],
    environment: dict[str, Any],
    vendored: list[dict[str, Any]],
    npm: list[dict[str, Any]],
) -> dict[str, Any]:
    """The CycloneDX bill: the environment's components that a user gets, with their licences, beneath loopwright."""
    known = {_canonical(c["name"]): c for c in environment["components"]}
    ours = known[NAME]
    components = [_component(known[p["name"]], p) for p in packages] + vendored + [_npm_component(p) for p in npm]
    refs = {c["bom-ref"] for c in components} | {ours["bom-ref"]}
    edges = [
        {"ref": edge["ref"], "dependsOn": sorted(ref for ref in edge.get("dependsOn", ()) if ref in refs)}
        for edge in environment["dependencies"]
        if edge["ref"] in refs
    ]
    for edge in edges:
        if edge["ref"] == ours["bom-ref"]:
            edge["dependsOn"] += [c["bom-ref"] for c in vendored]
            edge["dependsOn"] += [_npm_url(p) for p in npm if p["name"] == ON_THE_PAGE]
    edges += [{"ref": c["bom-ref"]} for c in vendored]
    urls = {p["name"]: _npm_url(p) for p in npm}  # a name stands once: the lock holds no second version
    edges += [{"ref": _npm_url(p), "dependsOn": [urls[name] for name in p.get("dependencies", ())]} for p in npm]
    main = {key: ours[key] for key in ("bom-ref", "description", "name", "version")}
    main |= {"type": "library", "purl": f"pkg:pypi/{NAME}@{ours['version']}", "licenses": [{"expression": OURS}]}
    metadata = {**environment["metadata"], "component": main}
    return {**environment, "metadata": metadata, "components": components, "dependencies": edges}


def uplot() -> dict[str, Any]:
    """The component uPlot, which lies in the wheel: its version stands at the head of its file."""
    script = STATIC / "uPlot.iife.min.js"
    found = re.match(r"/\*! https://github\.com/leeoniya/uPlot \(v([\d.]+)\)", script.read_text(encoding="utf-8"))
    if found is None or "MIT License" not in (STATIC / "uPlot-LICENSE").read_text(encoding="utf-8"):
        raise UnclearError("serving/page/static: uPlot's version or licence is not where it was")
    return _vendored("uPlot", found[1], f"pkg:npm/uplot@{found[1]}", script)


def header() -> dict[str, Any]:
    """The component onnxruntime_c_api.h, which lies in the wheel: it names the release of its interface."""
    file = C_HEADER / "onnxruntime_c_api.h"
    found = re.search(r"#define ORT_API_VERSION (\d+)", file.read_text(encoding="utf-8"))
    if found is None or "MIT License" not in (C_HEADER / "LICENSE").read_text(encoding="utf-8"):
        raise UnclearError("pipeline/hosts/c/onnxruntime: the header's version or licence is not where it was")
    version = f"1.{found[1]}"
    return _vendored("onnxruntime_c_api.h", version, f"pkg:github/microsoft/onnxruntime@v{version}.0", file)


def _vendored(name: str, version: str, purl: str, file: Path) -> dict[str, Any]:
    return {
        "bom-ref": f"{name}=={version}",
        "type": "library",
        "name": name,
        "version": version,
        "purl": purl,
        "licenses": [{"expression": "MIT"}],
        "hashes": [{"alg": "SHA-256", "content": hashlib.sha256(file.read_bytes()).hexdigest()}],
        "properties": [
            {"name": BROUGHT, "value": "runtime"},
            {"name": LIES_IN, "value": file.relative_to(ROOT).as_posix()},
        ],
    }


def page(packages: list[dict[str, Any]], vendored: list[dict[str, Any]], version: str, python: str = "") -> str:
    """The licences in Markdown."""
    copyleft = [p for p in packages if p["kind"] > Kind.PERMISSIVE]
    choices = [p for p in packages if p["kind"] == Kind.PERMISSIVE and has_choice(p["expression"])]
    head = ["package", "version", "licence", "brought by"]
    ours = [[c["name"], c["version"], c["licenses"][0]["expression"], "lies in the wheel"] for c in vendored]
    lines = ["# Licences", "", ABOUT.format(version=version, python=python), "## Copyleft", ""]
    lines += _table([*head, "copyleft"], [[*_cells(p), WORDS[p["kind"]]] for p in copyleft])
    chosen = ", ".join(f"{p['name']} ({p['expression']})" for p in choices) or "none"
    lines += ["", f"A permissive licence may be chosen instead of copyleft for: {chosen}."]
    lines += ["", "## All", "", *_table(head, [*ours, *map(_cells, packages)])]
    return "\n".join(lines) + "\n"


def _cells(package: dict[str, Any]) -> list[str]:
    return [package["name"], package["version"], package["expression"], ", ".join(package["by"])]


def _table(head: list[str], body: list[list[str]]) -> list[str]:
    return [f"| {' | '.join(cells)} |" for cells in [head, ["---"] * len(head), *body]]


def _component(component: dict[str, Any], package: dict[str, Any]) -> dict[str, Any]:
    """A component of the environment with its licence and what brings it, without places of this machine."""
    stated = package["expression"]
    licences = [{"license": {"name": stated}}] if stated == BSD else [{"expression": stated}]
    known = [r for r in component.get("externalReferences", ()) if not r["url"].startswith("file:")]
    about = [*component.get("properties", ()), *({"name": BROUGHT, "value": extra} for extra in package["by"])]
    kept = {key: value for key, value in component.items() if key != "externalReferences"}
    return kept | {"licenses": licences, "properties": about} | ({"externalReferences": known} if known else {})


def _canonical(name: str) -> str:
    return re.sub(r"[-_.]+", "-", name).lower()


def main(closure: str, environment: str, folder: str) -> int:
    """Write both files; 2 after a line on standard error where a licence is unclear or the bill is not valid."""
    try:
        packages, vendored, npm = rows(json.loads(Path(closure).read_text())), [uplot(), header()], fetched()
    except UnclearError as error:
        print(f"bill: {error}", file=sys.stderr)
        return 2
    whole = bill(packages, json.loads(Path(environment).read_text()), vendored, npm)
    text = json.dumps(whole, indent=1, ensure_ascii=False) + "\n"
    wrong = JsonStrictValidator(SchemaVersion.V1_6).validate_str(text)
    if wrong is not None:
        print(f"bill: the bill of materials is not valid CycloneDX: {wrong}", file=sys.stderr)
        return 2
    version = whole["metadata"]["component"]["version"]
    python = f" on Python {sys.version_info.major}.{sys.version_info.minor}"
    Path(folder, f"{NAME}-{version}.cdx.json").write_text(text, encoding="utf-8")
    Path(folder, f"{NAME}-{version}-licences.md").write_text(
        page(packages + npm, vendored, version, python), encoding="utf-8"
    )
    copyleft = sorted(p["name"] for p in packages + npm if p["kind"] > Kind.PERMISSIVE)
    print(f"{len(whole['components'])} components, each with its licence; copyleft: {', '.join(copyleft)}")
    return 0


if __name__ == "__main__":
    sys.exit(main(*sys.argv[1:]))
