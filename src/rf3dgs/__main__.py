"""`python -m rf3dgs`."""

from rf3dgs.cli.main import entry

entry()
