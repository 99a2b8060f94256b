"""Tables of coefficients."""
