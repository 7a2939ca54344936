"""What no controller can beat: collocation, horizon, NMPC and the stored bounds."""
