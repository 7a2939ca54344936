"""Local linear models and the linearized plant."""
