"""A flat mirror: a plane with a boundary polygon. Imports no other kind."""
