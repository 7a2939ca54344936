"""Hybrid fuzzy models and their identification. A paper's own matrices stand in its case's folder."""
