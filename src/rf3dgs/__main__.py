"""`python -m rf3dgs`."""

import sys

from rf3dgs.cli.main import main

sys.exit(main())
