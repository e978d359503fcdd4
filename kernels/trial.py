"""Which of the ways that are tried on a GPU are taken, for measuring: all, less those that a variable names."""

from __future__ import annotations

import os

VARIABLE = "WARP_AR_WITHOUT"
"""Environment variable: names of ways not to take, separated by commas; asked when a pipeline is built."""


def tried(name: str) -> bool:
    """Whether a way is taken."""
    return name not in os.environ.get(VARIABLE, "").split(",")
