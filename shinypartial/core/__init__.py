"""Conventions, cameras, the sphere of directions, meshes, color and errors. Imports no other room."""
