"""`python -m counterspin`: the command line."""

import sys

from counterspin.cli import main

sys.exit(main())
