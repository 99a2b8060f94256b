"""The command ``eip-scipy solar-system``."""
