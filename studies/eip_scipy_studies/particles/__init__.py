"""The command ``eip-scipy charged-particle``, and ``reproduce fig-particle`` and ``fig-tokamak``."""
