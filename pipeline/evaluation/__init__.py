"""Evaluation of laws: cases, metrics, trials of exported files, evidence and verdicts.

Drawing and pages are elsewhere.
"""
