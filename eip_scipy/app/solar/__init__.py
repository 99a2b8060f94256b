"""``solar-system``, with ``--truth`` and ``--frontier``."""
