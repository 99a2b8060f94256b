"""Charged particles in fields."""
