"""Execute examples/notebooks in place: ``python tools/run_notebooks.py [FILE.ipynb ...] [--into FOLDER]``.

What a run leaves behind of its machine is cleared: times of execution, versions, folders. A second run so gives the
same file but for numbers of time. Ends with 1 where a cell raises; that notebook stays as it was.
"""

from __future__ import annotations

import argparse
import os
import re
import resource
import sys
import tempfile
import time
from pathlib import Path

import nbformat
from nbclient import NotebookClient
from nbclient.exceptions import CellExecutionError

ROOT = Path(__file__).resolve().parents[1]
FOLDER = ROOT / "examples" / "notebooks"
TIMEOUT_S = 600  # of a cell
METADATA = {
    "kernelspec": {"display_name": "Python 3", "language": "python", "name": "python3"},
    "language_info": {"name": "python"},
}
TEXTS = ("text/plain", "text/html")


def executed(path: Path) -> nbformat.NotebookNode:
    """The notebook at ``path`` with new outputs, run in its own folder; CellExecutionError where a cell raises."""
    notebook = nbformat.read(path, as_version=4)
    for cell in notebook.cells:
        cell.metadata.pop("execution", None)

    def progress(cell: nbformat.NotebookNode, cell_index: int) -> None:
        print(f"{path.name}: cell {cell_index + 1} of {len(notebook.cells)}", flush=True)

    NotebookClient(
        notebook,
        timeout=TIMEOUT_S,
        kernel_name="python3",
        resources={"metadata": {"path": str(path.parent)}},
        record_timing=False,
        coalesce_streams=True,
        on_cell_start=progress,
    ).execute()
    clear(notebook, path.name)
    return notebook


def clear(notebook: nbformat.NotebookNode, name: str) -> None:
    """Take out what tells of the machine: versions, and the folders of the checkout, packages and temporary files.

    What a cell writes to stderr goes there: how far it is, and warnings, which a notebook should not have.
    """
    notebook.metadata = nbformat.from_dict(METADATA)
    for cell in notebook.cells:
        for output in cell.get("outputs", []):
            if output.get("name") == "stderr":
                print(*(f"{name}: {line}" for line in output["text"].splitlines()), sep="\n", file=sys.stderr)
        if "outputs" in cell:
            cell.outputs = [output for output in cell.outputs if output.get("name") != "stderr"]
        for output in cell.get("outputs", []):
            if "text" in output:
                output["text"] = without_folders(output["text"])
            for kind in TEXTS:
                if kind in output.get("data", {}):
                    output["data"][kind] = without_folders(output["data"][kind])


def without_folders(text: str) -> str:
    """The text with paths that begin at a folder which others know."""
    temporary = re.escape(tempfile.gettempdir())
    text = re.sub(rf"{temporary}/(?:ipykernel_\d+/\d+\.py|tmp\w+/)", "", text)
    for folder in (str(ROOT), sys.prefix, str(Path.home())):
        text = text.replace(f"{folder}/", "")
    return text


def main() -> int:
    """Run the notebooks that are named, or all."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("files", nargs="*", type=Path, metavar="FILE.ipynb", help="default: all of examples/notebooks")
    parser.add_argument("--into", type=Path, metavar="FOLDER", help="write there, and leave the notebooks as they are")
    asked = parser.parse_args()
    # The kernel imports this checkout, also where another one is installed.
    roots = [str(ROOT / "tools" / "roots"), *filter(None, [os.environ.get("PYTHONPATH")])]
    os.environ["PYTHONPATH"] = os.pathsep.join(roots)
    failed = 0
    for path in asked.files or sorted(FOLDER.glob("*.ipynb")):
        began, used = time.monotonic(), _used_s()
        try:
            notebook = executed(path.resolve())
        except CellExecutionError as error:
            print(f"{path.name}: {error}", file=sys.stderr)
            failed = 1
            continue
        to = path if asked.into is None else asked.into / path.name
        nbformat.write(notebook, to)
        took, worked = time.monotonic() - began, _used_s() - used
        print(
            f"{path.name}: {took:.0f} s, {worked:.0f} s of processor time, {to.stat().st_size / 1e3:.0f} kB", flush=True
        )
    return failed


def _used_s() -> float:
    """Processor time of the kernels that have ended [s]."""
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


if __name__ == "__main__":
    sys.exit(main())
