"""How far a finished fit is to be trusted, from its training views alone. Imports selection and below."""
