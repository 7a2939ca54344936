"""Inverse control: direct inverses, applicability domain, disturbance observers."""
