"""The Structured Text of controllers through MATIEC, a compiler of IEC 61131-3, and gcc: its test program's verdict.

``python benchmarks/matiec.py MATIEC [FILE ...] [--compiler "gcc -O1"]``: MATIEC is the folder of a built
https://github.com/beremiz/matiec (autoreconf -i; ./configure; make). Of each file (all shipped ones) the types, step,
guard and test program become C, and the test program runs until it is done. Two of that compiler's faults are gone
round: it takes a single number above 3.4E38 or below 1.2E-38 for none of LREAL, so that those become 1E37 and 1E-37
(the test's infinite numbers are then large ones), and its C leaves out a loop of one round, which is mended in the C.
Half a minute a predictive file.
"""

from __future__ import annotations

import argparse
import re
import shlex
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from loopwright.pipeline.export.structured_text.st_files import st_folder
from loopwright.serving import Controller

ROOT = Path(__file__).parents[1]
MOST_CYCLES = 2_000  # of a test program; it ends after 250 to 400
EXTREME = re.compile(r"\b\d\.\d+E([+-])308\b")
LOOP = re.compile(r"(int __do_increment = 0;\s*while\( )(.+?) (<|>) (.+?) \) \{")
CONFIGURATION = """CONFIGURATION config
RESOURCE res ON PLC
TASK cyclic(INTERVAL := T#100ms, PRIORITY := 0);
PROGRAM made WITH cyclic : law_test;
END_RESOURCE
END_CONFIGURATION
"""
MAIN = """#include <stdio.h>
#include "iec_std_lib.h"
#include "accessor.h"
#include "POUS.h"
TIME __CURRENT_TIME;
BOOL __DEBUG;
extern LAW_TEST RES__MADE;
void config_init__(void);
void config_run__(unsigned long tick);
int main(void)
{
    unsigned long k = 0;
    config_init__();
    while (!RES__MADE.DONE.value && k < MOST) {
        config_run__(k++);
    }
    printf("%d %lu %d %d\\n", (int)RES__MADE.DONE.value, k, (int)RES__MADE.STEPS_WRONG.value,
           (int)RES__MADE.SCANS_WRONG.value);
    return 0;
}
"""


def row(file: Path, matiec: Path, compiler: str) -> str:
    """The verdict on one file."""
    files, _ = st_folder(Controller(file), "law")
    text = "\n".join(files[f"law_{part}.st"] for part in ("types", "step", "guard", "test")) + CONFIGURATION
    began = time.monotonic()
    with tempfile.TemporaryDirectory() as made:
        folder = Path(made)
        (folder / "all.st").write_text(EXTREME.sub(r"1.0E\g<1>37", text), encoding="utf-8")
        command = [str(matiec / "iec2c"), "-I", str(matiec / "lib"), "-T", made, str(folder / "all.st")]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        pous = folder / "POUS.c"
        if done.returncode or not pous.is_file():
            return f"{file.parent.name}/{file.stem:28s} not translated: {(done.stdout + done.stderr).strip()[:200]}"
        mended = LOOP.sub(r"\1__do_increment ? (\2 \3 \4) : (\2 \3= \4) ) {", pous.read_text("utf-8"))
        pous.write_text(mended, encoding="utf-8")
        (folder / "main.c").write_text(MAIN.replace("MOST", str(MOST_CYCLES)), encoding="utf-8")
        sources = ["main.c", "config.c", "res.c"]
        build = [*shlex.split(compiler), "-w", "-ffp-contract=off", f"-I{matiec / 'lib' / 'C'}", "-I.", *sources]
        subprocess.run([*build, "-lm", "-o", "test"], cwd=folder, check=True)
        ran = subprocess.run([str(folder / "test")], capture_output=True, text=True, check=True)
    finished, cycles, steps, scans = map(int, ran.stdout.split())
    verdict = f"{steps} steps wrong, {scans} scans wrong" if finished else "NOT DONE"
    return f"{file.parent.name}/{file.stem:28s} {cycles} cycles, {verdict}, {time.monotonic() - began:.0f} s"


def main(argv: list[str]) -> int:
    """Print the rows."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("matiec", type=Path, help="folder of a built MATIEC")
    parser.add_argument("files", nargs="*", type=Path, help="controller files (all shipped ones)")
    parser.add_argument("--compiler", default="gcc -O1", help="and its options")
    options = parser.parse_args(argv)
    for file in options.files or sorted((ROOT / "artifacts").glob("*/*.onnx")):
        print(row(file, options.matiec.resolve(), options.compiler), flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
