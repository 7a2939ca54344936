"""Reactor with three steady states."""
