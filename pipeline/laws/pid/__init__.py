"""The fixed PID. Its tuning rules stand in ``tuning``, other PIDs with the model that they use."""
