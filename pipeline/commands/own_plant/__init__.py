"""Parts of ``loopwright new``: signals of an export, a simulator or an FMU, what a person knows, printed lines."""
