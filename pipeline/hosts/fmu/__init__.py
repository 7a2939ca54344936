"""A controller file as a Functional Mock-up Unit for co-simulation, FMI 2.0 or 3.0, through fmpy and a C compiler."""
