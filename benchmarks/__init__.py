"""Benchmarks: speed and quality."""

import os

# torch's idle threads would spin and be counted; it reads this when it is imported.
os.environ.setdefault("OMP_WAIT_POLICY", "passive")
