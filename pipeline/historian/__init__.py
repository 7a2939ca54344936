"""Exports of plant historians: read, screened, put on one grid of time, and judged as data for a model.

``files`` reads a series a tag, ``cleaning`` checks readings and puts them on rows, ``screening`` makes the Record and
its account. ``excitation`` says whether the record can carry a model, ``step_test`` what to do where it cannot.
"""
