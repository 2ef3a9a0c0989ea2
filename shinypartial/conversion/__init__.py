"""A prediction as files that other programs open, what other methods' code wrote as a prediction, and captures of
public sets as a dataset.

Imports prediction and blender.
"""
