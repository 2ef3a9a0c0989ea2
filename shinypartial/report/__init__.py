"""HTML pages and charts of scores. Imports comparison and below."""
