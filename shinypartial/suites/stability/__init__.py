"""How far methods bear worse data: axes and their levels, the plan, and the page."""
