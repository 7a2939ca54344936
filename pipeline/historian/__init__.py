"""Exports of plant historians: read, screened, put on one grid of time, and judged as data for a model.

Files -> ``reading`` -> a series a tag -> ``cells`` -> ``resampling`` -> ``stretches`` -> ``screening`` -> Record.
``excitation`` says whether the record can carry a model, ``step_test`` what to do where it cannot.
"""
