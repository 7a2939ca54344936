"""Figures of the response of a plant: dead time, settling time and slope.

Plain arrays in, numbers out. The definitions stand here once, and beside them the bands of every place that asks.
"""
