"""The command line: one frozen dataclass per command."""
