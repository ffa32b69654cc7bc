"""The table that judges radiance models against lookup, by one command: what is asked, checked and shown."""
