"""From plants and plant data to published controllers. What runs them on a plant is ``serving``."""
