"""Laws that linearize an NNARX at every sample."""
