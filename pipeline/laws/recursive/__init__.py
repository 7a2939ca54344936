"""Laws that go on learning a linear model in the loop. Its first training stands in ``models/lagged``."""
