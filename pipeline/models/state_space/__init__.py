"""State-space networks."""
