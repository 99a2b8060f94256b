"""Mechanisms with known motions, and a study of them."""
