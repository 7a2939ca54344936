"""The fixed PID."""
