"""Formatting of values and suggestions in error messages, and the range of numbers in files."""

from __future__ import annotations

import difflib
import json
import math
import re
from collections.abc import Iterable
from typing import Any, Final

# Bounds within which the square of a number is finite and normal in single precision.
LARGEST, SMALLEST = 1e18, 1e-18
MOST_PIXELS: Final = 65536


def show_value(value: object) -> str:
    """Return a value as TOML, on one line and shortened."""
    try:
        text = json.dumps(value, ensure_ascii=False, default=str)
    except (ValueError, RecursionError):  # an integer with more digits than Python converts to text
        return "a number of thousands of digits"
    return text if len(text) <= 80 else f"{text[:60]}... ({len(text)} characters)"


def show_key(key: str) -> str:
    """Return a key as TOML, on one line and shortened."""
    return key if re.fullmatch(r"[A-Za-z0-9_-]{1,60}", key) else show_value(key)


def is_number(value: Any) -> bool:
    """Return True if a word or value is a finite number."""
    try:
        return math.isfinite(float(value))
    except (TypeError, ValueError):
        return False


def nearest(word: str, known: Iterable[str]) -> str:
    """Return the text after "unknown" in a message: the most similar known word, or all known words."""
    known = list(known)
    close = difflib.get_close_matches(word.lower(), [name.lower() for name in known], n=1, cutoff=0.6)
    if close:
        return f'did you mean "{next(name for name in known if name.lower() == close[0])}"?'
    return f"known: {', '.join(known[:20])}{', ...' if len(known) > 20 else ''}"
