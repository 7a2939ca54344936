"""Local controllers blended over local models."""
