"""``python -m surfconv_ops``: see :mod:`surfconv_ops.cli`."""

import sys

from .cli import main

if __name__ == "__main__":
    sys.exit(main())
