"""What joins Blender to the dataset format: rendered datasets, and films of a phone with the truth beside them.

Imports blender, dataset, scene and the rooms below.
"""
