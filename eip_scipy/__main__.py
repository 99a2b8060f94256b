"""``python -m eip_scipy``: the command line, which is in `eip_scipy_studies`."""

import sys

from eip_scipy_studies.cli import main

if __name__ == "__main__":
    sys.exit(main())
