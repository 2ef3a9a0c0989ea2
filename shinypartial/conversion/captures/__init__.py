"""Photographs of public sets of real objects, each in its own layout, as a dataset folder."""
