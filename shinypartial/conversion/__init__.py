"""A prediction as files that other programs open: Blender, game engines, web pages. Imports prediction and blender."""
