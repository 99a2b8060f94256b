"""The commands ``eip-scipy hard-cases`` and ``eip-scipy hard-scenes``."""
