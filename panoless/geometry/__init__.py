"""What may mirror: one folder a kind, all of them a `Geometry` of `base`. Imports first_surface, environment and
below.
"""
