"""A mirror ball: center and radius by its silhouettes. Imports no other kind."""
