"""One protocol for every method: positions and their split, data, cells of a table, and what can be said from them."""
