"""MVs one by one: those that the plant has itself, and those that an operator moves while the law has the others."""
