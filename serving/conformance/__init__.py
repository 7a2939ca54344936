"""The conformance kit: test vectors of one controller file, for a host in any language."""
