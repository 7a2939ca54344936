"""Laws that follow a reference model, and their training in closed loop. The plant's model stands in ``models``."""
