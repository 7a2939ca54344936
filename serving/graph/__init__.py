"""The graph of a controller file, before any runtime has it: its bytes, operators, work of a step, and the audit."""
