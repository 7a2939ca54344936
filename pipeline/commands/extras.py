"""Packages that a command needs beside numpy and onnxruntime, and the extra of loopwright that brings each."""

from __future__ import annotations

import json
import re
from importlib.metadata import PackageNotFoundError, distributions, requires
from urllib.parse import urlsplit
from urllib.request import url2pathname

NAME = "loopwright"
# Packages that are imported under another name than they are installed under.
INSTALLED_AS = {
    "PIL": "pillow",
    "cvxpy": "cvxpy-base",
    "dask": "distributed",
    "sklearn": "scikit-learn",
    "yaml": "pyyaml",
}
OWN = ("dev",)  # which tests loopwright itself


def advice(module: str) -> str | None:
    """The extra that brings a module that is not installed, as the end of an error; None where no extra does."""
    extra = extra_of(module)
    if extra is None:
        return None
    clone = _clone()
    wanted = f"'{NAME}[{extra}]'" if clone is None else f"-e '{clone}[{extra}]'"
    return f"{module.partition('.')[0]} is not installed; pip install {wanted} brings it"


def _clone() -> str | None:
    """Folder of the sources that loopwright is installed from where they stand; None of a wheel."""
    installed = [json.loads(found.read_text("direct_url.json") or "{}") for found in distributions(name=NAME)]
    urls = [said["url"] for said in installed if said.get("dir_info", {}).get("editable")]
    return url2pathname(urlsplit(urls[0]).path) if urls else None


def extra_of(module: str) -> str | None:
    """The first extra whose requirements name the package that holds ``module``."""
    top = module.partition(".")[0]
    package = _canonical(INSTALLED_AS.get(top, top))
    return next((extra for extra, required in _required() if required == package and extra not in OWN), None)


def _required() -> list[tuple[str, str]]:
    """Extra and package of each requirement, in the order of pyproject.toml."""
    try:
        lines = requires(NAME) or []
    except PackageNotFoundError:  # run from its sources, and not installed
        return []
    found = []
    for line in lines:
        package, extra = re.match(r"[\w.-]+", line), re.search(r"extra\s*==\s*['\"]([\w-]+)['\"]", line)
        if package and extra:
            found.append((extra[1], _canonical(package[0])))
    return found


def _canonical(package: str) -> str:
    return re.sub(r"[-_.]+", "-", package).lower()
