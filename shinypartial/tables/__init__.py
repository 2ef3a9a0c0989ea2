"""The paper's tables with our figures beside its own: a plan of our own commands, run by Snakemake, and its page.

Runs every method as a command on folders; may import pages, scores, formats and recipes, never the generator.
"""
