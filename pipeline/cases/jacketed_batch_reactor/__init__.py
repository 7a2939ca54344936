"""Batch vessel with a throttled jacket and a hot or cold valve."""
