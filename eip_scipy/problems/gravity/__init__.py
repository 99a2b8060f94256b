"""Point masses: their equations and forces, the solar system, hard problems."""
