"""Models of past inputs and outputs: NNARX, ARX, and what is linearized from them at every sample."""
