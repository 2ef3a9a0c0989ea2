"""The only room that imports bpy, and only inside functions: assemble a scene and render views of it.

Imports scene, io and core; never dataset or metrics. It returns `RenderedView`; the command hands it to the dataset.
"""
