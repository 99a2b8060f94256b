"""The commands ``eip-scipy gpe ...`` and ``reproduce fig-efficiency``: Bose-Einstein condensates."""
