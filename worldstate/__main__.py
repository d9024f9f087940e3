"""``python -m worldstate``: the command line."""

import sys

from worldstate.cli.main import main

if __name__ == "__main__":
    sys.exit(main())
