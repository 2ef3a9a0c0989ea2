"""Arrays in, numbers out; every number's name, unit and direction is defined in `registry`.

Imports core; never dataset, files or blender. Torch is imported only inside the functions of `perceptual`.
"""
