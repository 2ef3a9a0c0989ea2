"""Silhouettes to a first mesh: the visual hull, completed where no silhouette touches the object. Imports capture."""
