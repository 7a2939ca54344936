"""CSTR with a reversible reaction, held by its feed."""
