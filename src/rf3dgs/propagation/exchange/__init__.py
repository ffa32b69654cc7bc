"""Paths of other programs and of measurements, in and out."""
