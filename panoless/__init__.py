"""Reconstruct the environment that a mirror-like object reflects, from photographs of one side of it.

Importing this package loads no torch; its rooms do, and the command line imports them inside its commands.
"""

__version__ = "0.1.0"
