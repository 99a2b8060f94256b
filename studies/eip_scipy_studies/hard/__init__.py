"""The command ``eip-scipy hard-cases``."""
