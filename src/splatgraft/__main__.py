"""`python -m splatgraft`: the command line, where the script is not on the path."""

import sys

from splatgraft.cli import main

sys.exit(main())
