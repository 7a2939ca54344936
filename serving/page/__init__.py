"""The operator's page of a loop, in a process of its own: it reads the journal and asks the loop, and holds neither up.

Needs the extra ``pip install 'loopwright[plant]'``.
"""
