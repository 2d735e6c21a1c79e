"""``python -m rayfix``."""

import sys

from rayfix.cli import main

if __name__ == "__main__":
    sys.exit(main())
