"""Models of past inputs and outputs: NNARX, ARX, and their linearization at a sample. No law stands here."""
