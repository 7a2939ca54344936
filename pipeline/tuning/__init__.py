"""Rules, model reduction, development loops, stability and recovery: what laws are tuned and examined with.

No law lives here.
"""
