"""Tests and loops over a plant: scenarios, closed and open loops, timetables, the live view.

How good a loop is stands in ``evaluation``.
"""
