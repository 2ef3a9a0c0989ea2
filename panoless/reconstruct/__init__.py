"""Views to a finished fit: choice, fit, map, visibility, and its state on disk. Imports selection and below."""
