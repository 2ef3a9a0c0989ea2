"""`python -m shinypartial.cli` runs the command line."""

import sys

from shinypartial.cli import main

if __name__ == "__main__":
    sys.exit(main())
