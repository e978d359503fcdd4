"""The error model: how precisely each stage computes, and which tests of hard cases watch over it.

Errors are relative to the largest value of a stage's output, and those of float32 arithmetic alone: what a method
leaves out (the distance of a lamp, the lobes of an order-2 series) is the price list's matter. The measured ones are
the largest differences from float64 twins on CPU; in a checkout, ``python -m tests.hard_cases.measure_errors`` measures
them anew.
"""

from __future__ import annotations

import dataclasses


@dataclasses.dataclass(frozen=True)
class StageNumerics:
    """What to expect of one stage's numbers."""

    precision: str
    """What it computes in."""
    expected: str
    """Worst error by analysis, with its cause."""
    measured: float | None
    """Worst error against a float64 twin; None where there is none, or integers are compared."""
    rows: tuple[int, ...]
    """Rows of the atlas of hard cases that concern it."""


NUMERICS: dict[str, StageNumerics] = {
    "unwrap": StageNumerics(
        "float32; running means",
        "3e-5: Newton's method to 1e-7 rad, times the pixels of a frame's width",
        1.1e-5,
        (1, 2, 3, 4, 5, 6, 13, 17, 18),
    ),
    "accumulate": StageNumerics(
        "float32; m + a (x - m), exact where x = m", "1e-6: an exponential and four roundings", 1.7e-7, (6, 7, 17, 18)
    ),
    "fill": StageNumerics(
        "float32; running means, normalised", "2e-6: one rounding a level and texel", 4.8e-7, (3, 4, 6, 17, 18)
    ),
    "recover": StageNumerics("float32", "1e-3: a fit of many terms", None, (6, 17)),
    "declip": StageNumerics("float32", "half a code", None, (6, 17)),
    "key_lights": StageNumerics(
        "float32; directions stepped by rotation",
        "4e-3: the edge of a lobe of whole texels; 6e-8 a step",
        3.1e-3,
        (4, 6, 10, 17),
    ),
    "diffuse": StageNumerics(
        "float32 sums of sums over tables made in float64",
        "1e-3: a texel's spread by its second moment; sums 1e-6",
        5.1e-4,
        (4, 5, 6, 17, 18),
    ),
    "specular": StageNumerics(
        "float32; versines, weights made in float64", "2e-6: sums over the map", 4.7e-7, (4, 5, 6, 8, 17, 18)
    ),
    "visibility": StageNumerics(
        "float32; error bound carried with every hit",
        "3e-5: twenty roundings at a grazing angle of 3 degrees",
        1.0e-6,
        (5, 13, 14, 17),
    ),
    "summed_area": StageNumerics(
        "uint32 modulo 2^32", "0: exact for boxes of up to 2^32 / 255 pixels", 0.0, (6, 11, 12, 17)
    ),
    "relight": StageNumerics(
        "float32 over an integer table",
        "1e-5: a dozen roundings; shadow edges by a pixel",
        3.0e-7,
        (5, 6, 9, 10, 13, 14, 17),
    ),
    "room_samples": StageNumerics(
        "float32, compensated cumulative sums",
        "2e-3: a sample may fall into the neighbouring texel",
        None,
        (4, 6, 17, 18),
    ),
    "room_shadow": StageNumerics(
        "float32; a ratio of equal sums, exactly 1 where nothing is shaded",
        "2e-2 of a pixel's factor: one ray of 64 past an edge",
        None,
        (6, 8, 13, 14, 17),
    ),
    "object_light": StageNumerics(
        "float32", "3e-2 of a pixel's irradiance: one ray of 32 past an edge", None, (6, 13, 14, 17)
    ),
    "shade": StageNumerics(
        "float32; log1p for exponents, cross products for peaks",
        "1e-4 of a highlight with an exponent of 1e5",
        None,
        (5, 6, 8, 9, 13, 14, 17, 18),
    ),
    "composite": StageNumerics(
        "float32 to 8-bit codes by exact thresholds", "half a code; untouched pixels to the bit", None, (6, 12, 17)
    ),
    "expose": StageNumerics(
        "float32 to 8-bit codes by exact thresholds", "half a code; exposure 1 to the bit", None, (6, 7, 11, 12, 17)
    ),
}
