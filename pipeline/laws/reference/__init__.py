"""Laws that follow a reference model."""
