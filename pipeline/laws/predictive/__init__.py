"""Model predictive control: an observer, a plan over a horizon, and the law of both."""
