"""Foreign and native layouts, one file each: read_ and write_ for foreign ones, save and load for ours."""
