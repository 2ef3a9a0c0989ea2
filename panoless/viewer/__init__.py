"""A finished or a running fit in the browser. Imports export, reconstruct and what lies below them; `server` alone
imports viser, inside its functions.
"""
