"""Plants in general: signals, a simulator, equations, steady states and linearization.

No plant under test lives here: each stands in its case's folder.
"""
