"""Functional Mock-up Units for co-simulation as plants, through fmpy, which is imported on first use."""
