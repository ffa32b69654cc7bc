"""Sets of traced positions by name: what `rf3dgs trace --preset NAME` asks for."""

from collections.abc import Mapping
from dataclasses import dataclass

from rf3dgs.propagation.config import TraceConfig


@dataclass(frozen=True)
class TracePreset:
    """How many receivers, how each is traced, and how many paths each must have before diffuse ones are merged."""

    rx_count: int
    trace: TraceConfig
    min_paths: int = 0


TRACE_PRESETS: Mapping[str, TracePreset] = {
    "paper": TracePreset(rx_count=800, trace=TraceConfig(depth=3, rays=300_000), min_paths=300_000),
}
"""paper: the size of the published lobby set, 800 positions with more than 300,000 paths each."""
