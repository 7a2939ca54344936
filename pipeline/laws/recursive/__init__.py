"""Laws that go on learning a linear model in the loop."""
