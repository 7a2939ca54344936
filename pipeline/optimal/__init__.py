"""The bounds of all controllers: collocation, horizon, NMPC, offline optimum. No controller to ship stands here."""
