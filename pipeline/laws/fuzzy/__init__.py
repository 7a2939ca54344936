"""The inverse of a hybrid fuzzy model, with observers or a PI. No identification stands here."""
