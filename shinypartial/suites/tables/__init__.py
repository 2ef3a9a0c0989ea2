"""The paper's tables with our figures beside its own: the published ones, the plan, and the page."""
