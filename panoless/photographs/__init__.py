"""Photographs as a camera makes them to the dataset folder that a fit reads: frames, poses, masks. Imports capture and
shinypartial's formats; OpenCV and pycolmap inside functions.
"""
