"""`python -m splatgraft`: the command line, if the script is not on the path."""

import sys

from splatgraft.cli import main

sys.exit(main())
