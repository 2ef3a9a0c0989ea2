"""The released format: what a dataset folder holds, reading, writing and validating it.

May import the core (conventions, color, camera, sphere, images, files, errors); never blender or metrics.
"""
