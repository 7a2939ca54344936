"""The stages of the pipeline: each reads, calls the rooms below and writes. No computing stands here."""
