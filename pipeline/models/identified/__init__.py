"""State-space models of several inputs and outputs, identified from a record by their free run."""
