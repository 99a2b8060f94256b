"""The command ``eip-scipy reproduce``: the paper's tables and figures."""
