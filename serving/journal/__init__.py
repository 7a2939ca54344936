"""History of a loop, scan by scan, in one file: written by a thread of the loop, read by whoever may read the file."""

from loopwright.serving.journal.entries import EventEntry, JournalReader, ScanEntry, columns
from loopwright.serving.journal.writer import Journal

__all__ = ["EventEntry", "Journal", "JournalReader", "ScanEntry", "columns"]
