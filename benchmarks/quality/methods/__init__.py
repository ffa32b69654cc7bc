"""The methods that the benchmarks compare, one subject a file; each file lists its `METHODS`."""
