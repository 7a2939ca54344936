"""Loops and stations in worlds of the tests: what may happen is drawn or walked, and rules hold after each scan."""
