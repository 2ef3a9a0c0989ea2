"""Benchmark for recovering an environment from partial reflections: scenes, ground truth and scores.

Importing this package loads neither bpy nor torch; rooms that need them import them on use.
"""

__version__ = "0.1.0"
