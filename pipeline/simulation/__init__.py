"""Tests and loops over a plant: scenarios, closed and open loops, timetables, the live view.

How good a loop is stands in ``evaluation``.
"""

NOISE_SUFFIX = "_noise"
"""A scenario's name with measurement noise is its name with this at the end: ``held_out_noise``."""
