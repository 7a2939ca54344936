"""Figures of the response of a plant: dead time, settling time, slope, and its rest by running long.

Plain arrays in, numbers out. The definitions stand here once, and beside them the bands of every place that asks.
"""
