"""Measurements, read and grouped as reports need them."""
