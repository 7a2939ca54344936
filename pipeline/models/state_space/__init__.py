"""State-space networks. Models of past outputs stand in ``lagged``."""
