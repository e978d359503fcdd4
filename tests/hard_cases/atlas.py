"""The atlas of numerically hard cases: its rows, the stages that each concerns, and the tests that cover them.

A test says what it covers by ``@pytest.mark.atlas(row, stage, method)``. ``stage`` and ``method`` may be left out where
the test is parametrised by them; ``method="*"`` says that the test exercises what all methods of the stage share. Tests
that stand beside the kernel they test are listed in ``ELSEWHERE`` instead. ``tests/hard_cases/test_atlas.py`` sees to
it that no cell is empty.
"""

from __future__ import annotations

import json
import pathlib
from collections.abc import Iterable
from typing import Any

import pytest

from tests.hard_cases.rig import COMBINATIONS, METHODS, SLOW, methods_in

ROWS = {
    1: "straight back through the ball, the blind cone behind it, the silhouette",
    2: "perspective unwrapping of a ball that is near",
    3: "ball partly outside, hidden, 8 pixels across, touching the near plane",
    4: "poles and seam of latlong maps; odd, 1xN and other sizes",
    5: "acos and sqrt fed 1 + ulp; normals exactly +/-z",
    6: "suns, outliers, black maps, NaN, Inf, negative and denormal pixels",
    7: "accumulation over 10,000 frames: no drift, no decay, bad frames",
    8: "materials at their ends, grazing view and light",
    9: "lights on surfaces, inside objects, behind all; cones and intensities at their ends",
    10: "the paper's blend at alpha = -1, 0, 1; no or no single dominant light",
    11: "summed-area tables at 4K and 8K; boxes in corners and beyond the image",
    12: "exposure 0, 1, just below 1, above 1; saturated and black frames",
    13: "rays along axes, edges and vertices; broken meshes",
    14: "self-shadowing at 1 mm and 1 km, and 1 km from the origin",
    15: "marker edge-on, tiny, cut, mirrored, doubled, flipping, lost and found",
    16: "frames of wrong size, type or content; sources that break",
    17: "same answer: bands, replayed graphs, run to run, CPU and CUDA",
    18: "energy: constant under any mask, kept at every level and method",
}

TRACK, SOURCE, PIPELINE = "track", "source", "pipeline"
"""What is no stage of a plan: finding the marker, reading frames, and the frame's way as a whole."""

_RAYS = ("visibility", "shade", "relight", "environment_shadow", "near_field", "mirror_ball")
_GEOMETRY = ("visibility", "surfaces", "coverage", "motion")
"""Stages that read no radiance."""
CONCERNS: dict[int, tuple[str, ...]] = {
    1: ("unwrap", "recover", "mirror_ball", "declip"),
    2: ("unwrap", "declip"),
    3: ("unwrap", "fill", "recover", "mirror_ball"),
    4: (
        *("captured", "unwrap", "bracket", "fill", "recover"),
        *("key_lights", "irradiance", "prefilter", "environment_samples"),
    ),
    5: ("unwrap", "recover", "irradiance", "prefilter", *_RAYS, "declip"),
    6: (*(stage for stage in METHODS if stage not in _GEOMETRY), PIPELINE),
    7: ("bracket", "accumulate", "recover", "expose", PIPELINE),
    8: ("prefilter", "shade", "environment_shadow", "near_field", "mirror_ball", "gloss"),
    9: ("relight", "shade", "mirror_ball"),
    10: ("key_lights", "relight"),
    11: ("summed_area", "expose"),
    12: ("summed_area", "recover", "composite", "declip", "expose"),
    13: ("unwrap", "recover", *_RAYS, "declip"),
    14: ("unwrap", "recover", *_RAYS, "declip"),
    15: (TRACK, PIPELINE),
    16: (SOURCE, PIPELINE),
    17: (*METHODS, PIPELINE),
    18: (
        "unwrap",
        "bracket",
        "accumulate",
        "fill",
        "recover",
        "irradiance",
        "prefilter",
        "environment_samples",
        "environment_shadow",
        "near_field",
        "shade",
        "mirror_ball",
    ),
}


def _paper(*cells: tuple[int, str]) -> tuple[tuple[int, str, str], ...]:
    """Cells of the paper's way to look the ball up: rows and stages."""
    return tuple((row, stage, "sphere_map" if stage == "unwrap" else "sphere_mip") for row, stage in cells)


ELSEWHERE: dict[str, tuple[tuple[int, str, str], ...]] = {
    "test_sphere_map.py::test_matches_twin": _paper((4, "unwrap"), (5, "unwrap"), (4, "irradiance"), (4, "prefilter")),
    "test_sphere_map.py::test_from_anywhere": _paper((1, "unwrap"), (2, "unwrap"), (3, "unwrap"), (14, "unwrap")),
    "test_sphere_map.py::test_a_constant_frame_is_a_constant_map": _paper(
        (18, "unwrap"), (18, "irradiance"), (18, "prefilter")
    ),
    "test_fill.py::test_nothing_known_is_no_light": ((3, "fill", "*"),),
    "test_prefilter.py::test_levels_grow_with_roughness_and_fall_with_shininess": ((8, "prefilter", "*"),),
    "test_recover.py::test_transfer_agrees_with_its_twin": ((1, "recover", "*"),),
    "test_recover.py::test_observation_reads_surfaces_and_nothing_else": ((3, "recover", "*"),),
    "test_recover.py::test_cells_keep_energy_and_recovered_returns_it": (
        (4, "recover", "*"),
        (18, "recover", "*"),
    ),
    "test_recover.py::test_all_that_is_estimated_is_finite_for_absurd_frames": (
        (6, "recover", "*"),
        (12, "recover", "*"),
    ),
    "test_bracket.py::test_around_a_lamp_one_exposure_has_the_say": ((4, "bracket", "*"),),
    "test_bracket.py::test_old_frames_of_other_exposures_are_forgotten": ((7, "bracket", "*"),),
    "test_bracket.py::test_equal_exposures_stay_equal": ((18, "bracket", "*"),),
    "test_declip.py::test_ball_pixel_off_the_middle_shows_what_it_mirrors": ((1, "declip", "*"), (2, "declip", "*")),
    "test_declip.py::test_never_below_clipping": ((6, "declip", "*"), (12, "declip", "*")),
    "test_mirror_ball.py::test_a_camera_close_to_the_ball": ((1, "mirror_ball", "*"), (3, "mirror_ball", "*")),
    "test_tracking.py::test_edge_on_loses_quality_and_never_breaks": ((15, TRACK, "*"),),
    "test_tracking.py::test_twelve_pixel_marker": ((15, TRACK, "*"),),
    "test_tracking.py::test_leaving_the_frame": ((15, TRACK, "*"),),
    "test_tracking.py::test_mirrored_marker_is_not_accepted": ((15, TRACK, "*"),),
    "test_tracking.py::test_two_with_one_id": ((15, TRACK, "*"),),
    "test_tracking.py::test_pose_does_not_flip": ((15, TRACK, "*"),),
    "test_tracking.py::test_found_held_lost_found": ((15, TRACK, "*"),),
    "test_sources.py::test_grey_alpha_and_16_bit_become_rgb": ((16, SOURCE, "*"),),
    "test_sources.py::test_image_of_32_bit_numbers_is_an_error": ((16, SOURCE, "*"),),
    "test_sources.py::test_damaged_image_is_named_after_the_frames_before_it": ((16, SOURCE, "*"),),
    "test_sources.py::test_size_that_changes_is_named": ((16, SOURCE, "*"),),
    "test_sources.py::test_empty_and_foreign_files": ((16, SOURCE, "*"),),
    "test_sources.py::test_truncated_video_gives_what_is_whole_and_names_the_frame": ((16, SOURCE, "*"),),
    "test_capture_device.py::test_device_drops_to_the_newest_and_reports_being_unplugged": ((16, SOURCE, "*"),),
}
"""(row, stage, method) of tests beside their kernels; an empty method is the test's own ``method`` parameter."""

Cell = tuple[int, str, str]


def methods_of(stage: str) -> tuple[str, ...]:
    """Methods of a stage on which it does something; ``default`` for what is no stage."""
    return METHODS.get(stage, ("default",))


def cells() -> list[Cell]:
    """Every (row, stage, method) that must be covered; stages that do not exist yet concern no row."""
    known = {*METHODS, TRACK, SOURCE, PIPELINE}
    return [
        (row, stage, method)
        for row, stages in CONCERNS.items()
        for stage in stages
        if stage in known
        for method in methods_of(stage)
    ]


def cells_of(item: Any) -> list[Cell]:
    """Cells that a collected test covers."""
    parameters = item.callspec.params if hasattr(item, "callspec") else {}
    function = getattr(item, "originalname", None) or item.name
    claims: list[tuple[int, str | None, str | None]] = []
    for mark in item.iter_markers("atlas"):
        claims.append((mark.kwargs["row"], mark.kwargs.get("stage"), mark.kwargs.get("method")))
    claims += [
        (row, stage, method or None) for row, stage, method in ELSEWHERE.get(f"{item.path.name}::{function}", ())
    ]
    found: list[Cell] = []
    for row, stage, method in claims:
        stage = stage or parameters.get("stage")
        if stage not in CONCERNS[row]:
            if "stage" in parameters:
                continue  # a test over all stages, of a row that does not concern this one
            raise ValueError(f"{item.nodeid}: row {row} of the atlas does not concern {stage!r}")
        methods = methods_of(stage)
        method = method or parameters.get("method") or (methods[0] if len(methods) == 1 else None)
        if method is None:
            raise ValueError(f"{item.nodeid}: say which method of {stage} it covers, or '*' for what all share")
        found += [(row, stage, one) for one in methods if method in ("*", one)]
    return found


def combinations(row: int, only: Iterable[str] | None = None) -> list[Any]:
    """Every combination of methods, as a parameter that says which cells of a row it covers; ``only`` names stages."""
    concerned = set(CONCERNS[row]) if only is None else set(only)
    found = []
    for name in COMBINATIONS:
        marks: list[pytest.MarkDecorator] = [pytest.mark.slow] if name in SLOW else []
        for stage, method in methods_in(name).items():
            if stage in concerned:
                marks.append(pytest.mark.atlas(row=row, stage=stage, method=method))
        found.append(pytest.param(name, marks=marks, id=name))
    return found


collected: list[Any] = []
"""Tests of this run, before any is left out; ``tests/conftest.py`` notes them."""


def coverage(items: Iterable[Any]) -> dict[str, list[str]]:
    """Which tests cover which cells: {"row/stage/method": [test, ...]}."""
    table: dict[str, list[str]] = {}
    for item in items:
        for row, stage, method in cells_of(item):
            table.setdefault(f"{row}/{stage}/{method}", []).append(item.nodeid)
    return table


def write_collection(items: Iterable[Any], path: pathlib.Path) -> None:
    """Write ``coverage`` as JSON."""
    path.write_text(json.dumps(coverage(items), indent=1))
