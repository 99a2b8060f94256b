"""``gpe``, and the condensates among the paper's figures."""
