"""Which kind of geometry a scene needs, how near its surroundings are, and what the mirror is made of: candidates,
their evidence and the verdict. Imports geometry and below.
"""
