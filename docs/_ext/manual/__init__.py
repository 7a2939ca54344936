"""What the manual takes from the code, and how Sphinx shows it."""
