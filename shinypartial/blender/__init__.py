"""The only room that imports bpy, and only inside functions: assemble a scene and render views of it.

May import the core (conventions, color, camera, sphere, trajectory, scene, images, errors); never dataset or metrics.
It returns `RenderedView`; the command hands it to the dataset.
"""
