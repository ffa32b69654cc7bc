"""Long work in shards that a killed run keeps, here or on a cluster."""
