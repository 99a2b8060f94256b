"""``hard-cases`` and ``hard-scenes``."""
