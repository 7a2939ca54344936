"""Laws that linearize an NNARX at every sample. Those that learn in the loop stand in ``recursive``."""
