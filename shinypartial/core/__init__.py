"""Conventions, cameras, the sphere of directions, color and errors. Imports no other room."""
