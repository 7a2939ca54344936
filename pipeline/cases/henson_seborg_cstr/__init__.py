"""CSTR held by its coolant."""
