"""How pieces of work run side by side, and how a stage's process starts.

Nothing here knows what the work is.
"""
