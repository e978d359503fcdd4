"""How far float32 kernels are from their float64 twins: the figures that ``warp_ar.numerics`` prints.

python -m tests.hard_cases.measure_errors

runs the twin tests and records, at every comparison of theirs, the largest difference over the largest value compared.
"""

from __future__ import annotations

import json
import sys
from typing import Any

import numpy as np
import pytest

TWINS = {
    "unwrap": ["tests/test_probe.py::test_corners_match_twin", "tests/test_probe.py::test_gather_matches_twin"],
    "accumulate": ["tests/test_environment.py::test_accumulation_matches_twin"],
    "fill": ["tests/test_environment.py::test_fill_matches_twin"],
    "key_lights": ["tests/test_environment.py::test_irradiance_is_that_of_a_facing_surface"],
    "diffuse": [
        "tests/test_irradiance.py::test_projection_is_the_twin_s",
        "tests/test_irradiance.py::test_the_reference_is_the_twin_s",
    ],
    "specular": ["tests/test_prefilter.py::test_the_reference_is_the_twin_s"],
    "visibility": ["tests/test_visibility.py::test_matches_reference"],
    "relight": ["tests/test_relight.py::test_matches_twin"],
    "shade": ["tests/test_shade.py::test_matches_reference"],
    "composite": ["tests/test_composite.py::test_matches_twin"],
    "expose": ["tests/test_exposure.py::test_box_matches_twin"],
    "summed_area": ["tests/test_summed_area.py::test_matches_twin"],
}


def main() -> int:
    compare, worst = np.testing.assert_allclose, {}

    def recording(stage: str) -> Any:
        def assert_allclose(actual: Any, desired: Any, *args: Any, **kwargs: Any) -> None:
            one, other = np.asarray(actual, np.float64), np.asarray(desired, np.float64)
            if one.size and np.isfinite(other).all():
                scale = np.abs(other).max() or 1.0
                worst[stage] = max(worst.get(stage, 0.0), float(np.abs(one - other).max() / scale))
            compare(actual, desired, *args, **kwargs)

        return assert_allclose

    for stage, tests in TWINS.items():
        np.testing.assert_allclose = recording(stage)
        code = pytest.main([*tests, "-q", "-p", "no:cacheprovider"])
        if code:
            return int(code)
    np.testing.assert_allclose = compare
    print(json.dumps(worst, indent=1))
    return 0


if __name__ == "__main__":
    sys.exit(main())
