"""``python -m warp_ar.farm``."""

from __future__ import annotations

import sys

from warp_ar.farm.cli import main

if __name__ == "__main__":
    sys.exit(main())
