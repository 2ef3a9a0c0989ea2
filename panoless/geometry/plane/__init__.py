"""A flat mirror: a plane with a boundary polygon."""
