"""Charged particles in electromagnetic fields."""
