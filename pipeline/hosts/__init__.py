"""Controller files for hosts other than Python: the host in C (``c/host.c``), and FMUs made of it."""
