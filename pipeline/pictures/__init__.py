"""Everything that draws, and how numbers and names are written in front of a person.

A picture that only one case has stands in that case's folder.
"""
