"""Photographs of a mirror ball to a dataset: its rim, the cone of its rim, and poses by what it mirrors.

Nothing else is needed: a photograph of a ball shows nearly all directions, so photographs from any two sides overlap.
"""
