"""A surface of revolution: an axis and a profile. Imports no other kind."""
