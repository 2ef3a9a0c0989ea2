"""Many fits by one command: plans of our own commands, which Snakemake runs and continues after any stop; their pages.

`stability` measures how far methods bear worse data. `tables` makes the paper's tables with our figures beside its own.
Methods are commands on folders. May import pages, scores, formats and recipes, never the generator.
"""
