"""The parts of the manual that come from the code, and how Sphinx shows them."""
