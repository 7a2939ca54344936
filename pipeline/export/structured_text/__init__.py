"""A controller's plain statements as Structured Text of IEC 61131-3."""
