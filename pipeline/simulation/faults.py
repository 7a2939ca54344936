"""Faults of a signal of a served plant."""

FAULTS = ("", "bad", "uncertain", "frozen", "text", "deleted", "int", "nan")  # "": nothing
