"""Which kind of geometry a scene needs, and how near its surroundings are: candidates, their evidence and the verdict.
Imports geometry and below.
"""
