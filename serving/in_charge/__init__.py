"""Controllers of a loop: the one that has the plant, and one on trial that takes over from it."""
