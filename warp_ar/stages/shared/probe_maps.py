"""Names of the maps that unwrapping a mirror ball gives."""

from __future__ import annotations

UNWRAPPED = ("radiance", "confidence", "clipped")
"""Parts of what unwrapping a frame gives; arrays are named ``probe_*``, those of all exposures ``bracket_*``."""
