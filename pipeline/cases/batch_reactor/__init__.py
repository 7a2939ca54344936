"""Exothermic batch reactor A -> B -> C."""
