"""The commands ``eip-scipy solar-system``, ``solar-system frontier`` and ``solar-system truth``."""
