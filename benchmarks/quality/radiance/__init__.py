"""The one table that judges radiance models against lookup: data, splits, cells, statistics, checks and pages."""
