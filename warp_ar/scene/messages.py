"""Values and near misses as error messages show them, and the limits of numbers in files."""

from __future__ import annotations

import difflib
import json
import math
import re
from collections.abc import Iterable
from typing import Any, Final

# Beyond these a square leaves single precision.
LARGEST, SMALLEST = 1e18, 1e-18
MOST_PIXELS: Final = 65536


def show_value(value: object) -> str:
    """A value as a TOML file would have it, on one line and not too long."""
    try:
        text = json.dumps(value, ensure_ascii=False, default=str)
    except (ValueError, RecursionError):  # an integer with more digits than Python turns into text
        return "a number of thousands of digits"
    return text if len(text) <= 80 else f"{text[:60]}... ({len(text)} characters)"


def show_key(key: str) -> str:
    """A key as a TOML file would have it, on one line and not too long."""
    return key if re.fullmatch(r"[A-Za-z0-9_-]{1,60}", key) else show_value(key)


def is_number(value: Any) -> bool:
    """Return whether a word or value is a finite number."""
    try:
        return math.isfinite(float(value))
    except (TypeError, ValueError):
        return False


def nearest(word: str, known: Iterable[str]) -> str:
    """Return the words after "unknown": the nearest known word, or all of them."""
    known = list(known)
    close = difflib.get_close_matches(word.lower(), [name.lower() for name in known], n=1, cutoff=0.6)
    if close:
        return f'did you mean "{next(name for name in known if name.lower() == close[0])}"?'
    return f"known: {', '.join(known[:20])}{', ...' if len(known) > 20 else ''}"
