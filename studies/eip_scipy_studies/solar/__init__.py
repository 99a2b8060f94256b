"""``solar-system``, ``solar-system frontier`` and ``solar-system truth``."""
