"""params.yaml as frozen dataclasses: every section read, checked and named in its errors.

No default here holds a case's number; what a law or a model takes stands with the law or the model.
"""
