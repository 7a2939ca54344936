"""The pages of a case and the page over all cases, and the table in the terminal.

It knows no case by name, and loads no model, no store and no runtime.
"""
