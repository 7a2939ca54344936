"""History of a loop, scan by scan, in one file: written by a thread of the loop, read by whoever may read the file."""

from loopwright.serving.journal.entries import Event, JournalReader, Scan, columns
from loopwright.serving.journal.writer import Journal

__all__ = ["Event", "Journal", "JournalReader", "Scan", "columns"]
