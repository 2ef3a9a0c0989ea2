"""Trust: evidence and verdict."""
