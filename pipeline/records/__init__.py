"""Plant data: records in memory, and their files.

How an experiment is made stands in ``excitation``.
"""
