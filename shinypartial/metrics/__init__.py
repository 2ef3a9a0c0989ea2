"""Arrays in, numbers out; every number's name, unit and direction is defined in `registry`.

May import the core (conventions, color, sphere, errors); never dataset, files or blender. Torch is imported only inside
the functions of `perceptual`.
"""
