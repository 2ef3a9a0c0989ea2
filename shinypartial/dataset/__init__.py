"""The released format: what a dataset folder holds, reading, writing and validating it.

May import core and io; never blender or metrics.
"""
