"""How good a law is: cases, metrics, trials of exported files, evidence and verdicts.

Nothing here draws or makes pages.
"""
