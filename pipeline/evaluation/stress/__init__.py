"""Closed loops of one controller file over many plants drawn at random."""
