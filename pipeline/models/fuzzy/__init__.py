"""Hybrid fuzzy models."""
