"""Laws that invert a model, with domain or disturbance observer. The models stand in ``models/static``."""
