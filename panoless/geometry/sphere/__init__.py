"""A mirror ball: center and radius by its outlines. Imports no other kind."""
