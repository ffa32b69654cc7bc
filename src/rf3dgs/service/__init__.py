"""A field behind an HTTP interface."""
