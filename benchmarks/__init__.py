"""Benchmarks: speed and quality."""
