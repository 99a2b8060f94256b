"""``charged-particle``."""
