"""Sites: what stands in them, how it looks and reflects, where receivers and cameras stand."""
