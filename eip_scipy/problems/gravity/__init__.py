"""Point masses: their equations and forces, the solar system, and problems with close encounters."""
