"""Kinds of files that are no text: told by their first bytes, whatever their names say."""

from __future__ import annotations

import gzip
import zipfile
import zlib
from pathlib import Path

from loopwright.pipeline.errors import RecordError

GZIP, PARQUET, ZIP = b"\x1f\x8b", b"PAR1", b"PK\x03\x04"
# First bytes -> what the file is, and what to do with it.
OTHERS: tuple[tuple[bytes, str, str], ...] = (
    (b"\xd0\xcf\x11\xe0\xa1\xb1\x1a\xe1", "an old Excel workbook (.xls)", "save it as .xlsx or .csv"),
    (b"%PDF", "a PDF", "export the readings as .csv, .xlsx or .parquet"),
    (b"SQLite format 3\x00", "an SQLite database", "export the table of readings as .csv or .parquet"),
    (b"\x89HDF\r\n\x1a\n", "an HDF5 file, or a MATLAB file of version 7.3", "write its table as .csv or .parquet"),
    (b"MATLAB 5.0 MAT-file", "a MATLAB file", "write its table as .csv, with writetable"),
    (b"ARROW1", "an Arrow or Feather file", "write its table as .parquet"),
    (b"{\\rtf", "a document (.rtf)", "export the readings as .csv, .xlsx or .parquet"),
    (b"7z\xbc\xaf\x27\x1c", "a 7z archive", "unpack it and give the files in it"),
    (b"Rar!", "a rar archive", "unpack it and give the files in it"),
    (b"BZh", "a bzip2 archive", "unpack it and give the file in it"),
    (b"\xfd7zXZ", "an xz archive", "unpack it and give the file in it"),
    (b"\x28\xb5\x2f\xfd", "a zstd archive", "unpack it and give the file in it"),
)
MARKUP = ((b"<!doctype html", "a web page (HTML)"), (b"<html", "a web page (HTML)"), (b"<table", "a web page (HTML)"),
          (b"<?xml", "an XML file"))  # fmt: skip


def kind_of(path: Path) -> str:
    """How a file is to be read: "parquet", "workbook", "gzip" or "text".

    RecordError that names what it is where it is none of these.
    """
    with path.open("rb") as file:
        first = file.read(512)
    if first.startswith(PARQUET):
        return "parquet"
    if first.startswith(GZIP):
        return _gzipped(path)
    if first.startswith(ZIP):
        return _zipped(path)
    for mark, what, remedy in OTHERS:
        if first.startswith(mark):
            raise RecordError(f"{path} is {what}; {remedy}")
    begin = first.lstrip(b"\xef\xbb\xbf \t\r\n").lower()
    for mark, what in MARKUP:
        if begin.startswith(mark):
            raise RecordError(f"{path} is {what}; open it in a spreadsheet and save it as .xlsx or .csv")
    if begin.startswith((b'{"', b"{\n", b"{\r", b"[{", b"[\n", b"[[", b"{ ")):
        raise RecordError(f"{path} is a JSON file; write its table as .csv or .parquet")
    return "text"


def _gzipped(path: Path) -> str:
    try:
        first = head_of(path, "gzip", 512)
    except (OSError, EOFError, zlib.error):
        return "gzip"  # cut off, and said so where it is read
    kinds = (PARQUET, "a Parquet file"), (ZIP, "a workbook or a zip archive"), *((m, w) for m, w, _ in OTHERS)
    for mark, what in kinds:
        if first.startswith(mark):
            raise RecordError(f"{path} is {what}, gzipped; unpack it and give the file in it")
    return "gzip"


def _zipped(path: Path) -> str:
    try:
        with zipfile.ZipFile(path) as archive:
            names = archive.namelist()
            kind = archive.read("mimetype")[:80] if "mimetype" in names else b""
    except (zipfile.BadZipFile, OSError, KeyError, RuntimeError):
        raise RecordError(f"{path} is a zip archive, or a workbook, that is cut off; export the file again") from None
    if "xl/workbook.xml" in names:
        return "workbook"
    if "xl/workbook.bin" in names:
        raise RecordError(f"{path} is a binary Excel workbook (.xlsb); save it as .xlsx or .csv")
    if b"opendocument" in kind:
        raise RecordError(f"{path} is an OpenDocument file (.ods); save it as .xlsx or .csv")
    shown = ", ".join(names[:3])
    raise RecordError(f"{path} is a zip archive of {len(names)} files ({shown}); unpack it and give the files in it")


def head_of(path: Path, kind: str, size: int) -> bytes:
    """The first ``size`` bytes of a text, unpacked where it is gzipped."""
    with gzip.open(path, "rb") if kind == "gzip" else path.open("rb") as file:
        return file.read(size)
