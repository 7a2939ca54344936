"""Files of an export: how each is written, its columns, time stamps and numbers -> a series a tag (``Export``)."""
