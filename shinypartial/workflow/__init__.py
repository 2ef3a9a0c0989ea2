"""Plans of commands that Snakemake runs, and that continue after any stop; imports io."""
