"""Known future of a loop: set points of a recipe, forecasts of measured disturbances, and a law's input for them.

``ahead`` is that input; ``course`` has values by time, of which a loop makes it at each scan.
"""
