"""The certificate of a controller: what is fixed before the first loop runs, and the bound that the loops show."""
