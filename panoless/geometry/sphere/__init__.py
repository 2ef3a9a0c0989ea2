"""A mirror ball: center and radius by its outlines. Imports nothing of other kinds but surfels."""
