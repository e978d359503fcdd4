"""How far float32 kernels are from their float64 twins: the figures that stand in the stages' ``Numerics``.

python -m tests.hard_cases.measure_errors

runs the twin tests, which note every comparison's worst error, and prints the largest of each stage as JSON.
"""

from __future__ import annotations

import json
import sys

import pytest

from tests.error_model import worst

TWINS = (
    "tests/test_unwrap.py::test_corners_match_twin",
    "tests/test_unwrap.py::test_gather_matches_twin",
    "tests/test_accumulate.py::test_accumulation_matches_twin",
    "tests/test_fill.py::test_fill_matches_twin",
    "tests/test_key_lights.py::test_irradiance_is_that_of_a_facing_surface",
    "tests/test_bracket.py::test_twin",
    "tests/test_recover.py::test_transfer_agrees_with_its_twin",
    "tests/test_irradiance.py::test_projection_is_the_twin_s",
    "tests/test_irradiance.py::test_the_reference_is_the_twin_s",
    "tests/test_prefilter.py::test_the_reference_is_the_twin_s",
    "tests/test_visibility.py::test_matches_reference",
    "tests/test_summed_area.py::test_matches_twin",
    "tests/test_relight.py::test_matches_twin",
    "tests/test_environment_shadow.py::test_cumulative_sums_match_their_twin",
    "tests/test_environment_shadow.py::test_reference_method_matches_the_twin",
    "tests/test_near_field.py::test_matches_the_twin",
    "tests/test_materials.py::test_phong_matches_reference",
    "tests/test_materials.py::test_ggx_matches_reference",
    "tests/test_shade.py::test_matches_reference",
    "tests/test_mirror_ball.py::test_matches_twin",
    "tests/test_composite.py::test_matches_twin",
    "tests/test_declip.py::test_matches_twin",
    "tests/test_expose.py::test_box_matches_twin",
)
"""Tests that call ``tests.error_model.check_error``."""


def main() -> int:
    code = pytest.main([*TWINS, "-q", "-p", "no:cacheprovider"])
    print(json.dumps({stage: float(f"{error:.2g}") for stage, error in worst.items()}, indent=1))
    return int(code)


if __name__ == "__main__":
    sys.exit(main())
