"""A loop on a real plant: what loop.toml says, run for months. Needs the extra: ``pip install 'loopwright[plant]'``."""
