"""Which of the ways that are tried on a GPU are taken, for measuring: all, less those that a variable names."""

from __future__ import annotations

import os

VARIABLE = "WARP_AR_WITHOUT"
"""Environment variable: names of ways not to take, separated by commas; asked when a pipeline is built."""


ALSO = "WARP_AR_ALSO"
"""Environment variable: names of ways that are taken only where it names them."""


def also(name: str) -> bool:
    """Whether a way is taken that is left out unasked."""
    return name in os.environ.get(ALSO, "").split(",")


def tried(name: str) -> bool:
    """Whether a way is taken."""
    return name not in os.environ.get(VARIABLE, "").split(",")
