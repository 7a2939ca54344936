"""Readings and rows, checked: tags, faults of single readings, one grid of time, and the rows that count."""
