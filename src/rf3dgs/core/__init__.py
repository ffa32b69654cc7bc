"""What every layer shares: angles, frames, grids of directions, units, errors and progress."""
