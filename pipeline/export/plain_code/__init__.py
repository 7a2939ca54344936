"""A controller's graph as plain statements over arrays of doubles, from which C is printed."""
