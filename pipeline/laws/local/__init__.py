"""Local controllers blended over local models. The local models themselves stand in ``models/local_models.py``."""
