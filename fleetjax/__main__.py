"""`python -m fleetjax` is the command `fleetjax`."""

import sys

from fleetjax.cli import main

if __name__ == "__main__":
    sys.exit(main())
