"""A prediction as files that other programs open, and what other methods' code wrote as a prediction.

Imports prediction and blender.
"""
