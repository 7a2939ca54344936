"""The loop in a world of the tests: every sequence of acts up to a depth, and rules that hold after each scan."""
