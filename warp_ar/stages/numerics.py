"""The error model: how precisely each stage computes, and which tests of hard cases watch over it.

Errors are those of float32 arithmetic alone, over the largest value of a stage's output, or in 8-bit codes: what a
method leaves out (the distance of a lamp, the lobes of an order-2 series) is the cost table's matter. The bounds are
checked wherever a float64 twin exists; the measured errors are the largest differences from those twins on CPU, and
``python -m tests.hard_cases.measure_errors`` measures them anew in a checkout.
"""

from __future__ import annotations

import dataclasses


@dataclasses.dataclass(frozen=True)
class StageNumerics:
    """What to expect of one stage's numbers."""

    precision: str
    """What it computes in."""
    bound: float
    """Worst error by analysis."""
    cause: str
    """Where that error comes from."""
    measured: float
    """Worst error against a float64 twin."""
    rows: tuple[int, ...]
    """Rows of the atlas of hard cases that concern it."""
    codes: bool = False
    """Whether errors are in 8-bit codes."""

    @property
    def expected(self) -> str:
        """Bound and cause, as ``explain`` prints them."""
        bound = f"{self.bound:g} codes" if self.codes else f"{self.bound:.0e}"
        return f"{bound}: {self.cause}"


NUMERICS: dict[str, StageNumerics] = {
    "unwrap": StageNumerics(
        "float32; running means",
        1e-4,
        "Newton's method to 1e-7 rad, times the pixels of a frame's width, on noise",
        1.3e-05,
        (1, 2, 3, 4, 5, 6, 13, 14, 17, 18),
    ),
    "bracket": StageNumerics(
        "float32; running means", 2e-6, "a dozen roundings of weights and means", 3e-08, (4, 6, 7, 17, 18)
    ),
    "accumulate": StageNumerics(
        "float32; m + a (x - m), exact where x = m",
        1e-5,
        "an exponential and a dozen roundings",
        9.9e-08,
        (6, 7, 17, 18),
    ),
    "fill": StageNumerics(
        "float32; running means, normalised", 1e-5, "one rounding a level and texel", 4.8e-07, (3, 4, 6, 17, 18)
    ),
    "recover": StageNumerics(
        "float32 transfer, float64 solution",
        6e-4,
        "three steps of the search for the mirroring point",
        0.00016,
        (1, 3, 4, 5, 6, 7, 12, 13, 14, 17, 18),
    ),
    "key_lights": StageNumerics(
        "float32; directions stepped by rotation",
        4e-3,
        "the edge of a lobe falls between whole texels; 6e-8 a step",
        0.0031,
        (4, 6, 10, 17),
    ),
    "irradiance": StageNumerics(
        "float32 sums of sums over tables made in float64",
        1e-3,
        "a texel's spread by its second moment; sums 1e-6",
        0.00051,
        (4, 5, 6, 17, 18),
    ),
    "prefilter": StageNumerics(
        "float32; versines, weights made in float64",
        5e-5,
        "sums over the map, powers with exponents up to 1e3",
        4.7e-07,
        (4, 5, 6, 8, 17, 18),
    ),
    "visibility": StageNumerics(
        "float32; error bound carried with every hit",
        3e-5,
        "twenty roundings at a grazing angle of 3 degrees",
        4.6e-07,
        (5, 13, 14, 17),
    ),
    "summed_area": StageNumerics(
        "uint32 modulo 2^32", 0.0, "exact for boxes of up to 2^32 / 255 pixels", 0, (6, 11, 12, 17)
    ),
    "relight": StageNumerics(
        "float32 over an integer table; sums over samples and patches",
        5e-5,
        "a dozen roundings, sums over a thousand terms; shadow edges fall to either side",
        3e-07,
        (5, 6, 9, 10, 13, 14, 17),
    ),
    "environment_samples": StageNumerics(
        "float32, compensated cumulative sums",
        5e-6,
        "compensated along rows; one rounding a row over them",
        3.6e-07,
        (4, 6, 17, 18),
    ),
    "environment_shadow": StageNumerics(
        "float32; a ratio of equal sums, exactly 1 where less than 1/512 is shaded",
        2e-3,
        "rays at the rims of balls fall to either side",
        5.4e-06,
        (5, 6, 8, 13, 14, 17, 18),
    ),
    "near_field": StageNumerics(
        "float32",
        6e-2,
        "two rays of 64 at the picture's border see the desk or do not",
        2e-07,
        (5, 6, 8, 13, 14, 17, 18),
    ),
    "shade": StageNumerics(
        "float32; log1p for exponents, cross products for peaks",
        1e-4,
        "1e-7 of an angle, to the power of 1e5",
        4.1e-07,
        (5, 6, 8, 9, 13, 14, 17, 18),
    ),
    "mirror_ball": StageNumerics(
        "float32; points put back onto the ball and onto what it mirrors",
        2e-4,
        "twenty roundings, turned by the ball's curvature; edges fall to either side",
        1.8e-05,
        (1, 3, 5, 6, 8, 9, 13, 14, 17, 18),
    ),
    "composite": StageNumerics(
        "float32 to 8-bit codes by exact thresholds",
        0.501,
        "rounding to codes; untouched pixels to the bit",
        0.5,
        (6, 12, 17),
        codes=True,
    ),
    "declip": StageNumerics(
        "float32; sums of sums over a pyramid",
        2e-5,
        "sums over ten levels, and a power",
        1.9e-07,
        (1, 2, 5, 6, 12, 13, 14, 17),
    ),
    "expose": StageNumerics(
        "float32 to 8-bit codes by exact thresholds",
        0.501,
        "rounding to codes; exposure 1 to the bit",
        0.5,
        (6, 7, 11, 12, 17),
        codes=True,
    ),
}
