"""What a phone records of a scene, with the truth beside it. Imports generate, blender, dataset and the rooms below."""
