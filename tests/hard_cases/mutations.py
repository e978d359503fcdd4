"""Would the suite notice? For every row of the atlas one deliberate break, and the test that must turn red.

    python -m tests.hard_cases.mutations [ROW ...]

copies the checkout to a temporary folder, and there, one after another: runs the row's test, which must pass; breaks
the code by replacing one piece of text; runs the test again, which must fail; mends it. The checkout stays as it is.
"""

from __future__ import annotations

import argparse
import dataclasses
import os
import pathlib
import shutil
import subprocess
import sys
import tempfile

ROOT = pathlib.Path(__file__).resolve().parents[2]
COPIED = ("kernels", "scenes", "tests", "warp_ar", "pyproject.toml")


@dataclasses.dataclass(frozen=True)
class Mutation:
    """One break."""

    row: int
    what: str
    """What a hurried author might have written."""
    file: str
    old: str
    """Text that occurs there once."""
    new: str
    test: str
    """What must turn red, as pytest takes it."""


HARD = "tests/hard_cases/"
MUTATIONS = (
    Mutation(
        1,
        "straight back divides 0 by 0: no plane through the axis is picked",
        "kernels/probe.py",
        "            side = any_perpendicular(axis)\n        side = wp.normalize(side)\n",
        "            pass\n        side = side / wp.length(side)\n",
        f"{HARD}test_rows01_03_probe.py::test_light_straight_back_along_an_axis",
    ),
    Mutation(
        2,
        "orthographic unwrapping: the reflected ray of a camera at infinity",
        "kernels/probe.py",
        "        toward = wp.vec2(distance - n[0], -n[1])\n",
        "        toward = wp.vec2(1.0e6, 0.0)\n",
        "tests/test_probe.py::test_normals_reflect_every_direction_to_the_camera",
    ),
    Mutation(
        3,
        "samples outside the frame count",
        "kernels/probe.py",
        "                        if inside >= 0.0 and ramp > 0.0:\n",
        "                        if at[2] > rim_start:\n                            ramp = 1.0\n"
        "                            at[0] = wp.clamp(at[0], 0.0, last_column)\n"
        "                            at[1] = wp.clamp(at[1], 0.0, last_row)\n",
        "tests/test_probe.py::test_partly_outside_the_frame",
    ),
    Mutation(
        4,
        "half a texel's shift in every look-up of a packed level",
        "kernels/pyramid.py",
        "    y = row - 0.5\n    x = column - 0.5\n    i = wp.int32(wp.floor(y))",
        "    y = row - 0.5\n    x = column\n    i = wp.int32(wp.floor(y))",
        "tests/test_pyramid.py::test_sampling_follows_a_ramp_without_a_shift",
    ),
    Mutation(
        5,
        "the frame of a normal at -z divides by zero",
        "kernels/sampling.py",
        "    if normal[2] < 0.0:\n        sign = wp.float32(-1.0)\n",
        "",
        f"{HARD}test_rows04_05_directions.py::test_directions_an_ulp_beyond_unit_length",
    ),
    Mutation(
        6,
        "negative light accumulates",
        "kernels/environment.py",
        "    if wp.min(radiance) < 0.0:\n        return 0.0\n",
        "",
        f"{HARD}test_row06_garbage.py::test_what_is_no_light_is_gone_with_its_frame",
    ),
    Mutation(
        6,
        "filters take texels as they are",
        "kernels/pyramid.py",
        "    if value > 0.0:  # false for NaN\n        return wp.min(value, MAX_RADIANCE)\n    return 0.0\n",
        "    return value\n",
        f"{HARD}test_row06_garbage.py::test_any_map_gives_finite_light",
    ),
    Mutation(
        7,
        "a running mean that loses a little every frame",
        "kernels/environment.py",
        "        m = m + a * (x - m)\n",
        "        m = 0.99999 * m + a * (x - m)\n",
        "tests/test_environment.py::test_no_drift_over_ten_thousand_frames",
    ),
    Mutation(
        8,
        "1 - cos^2 instead of sin^2 at the peak of a mirror-like lobe",
        "kernels/materials.py",
        "    k = alpha / (wp.dot(cross, cross) + alpha * alpha * cos_h * cos_h)\n",
        "    k = alpha / (1.0 - cos_h * cos_h + alpha * alpha * cos_h * cos_h)\n",
        "tests/test_materials.py::test_ggx_matches_reference",
    ),
    Mutation(
        9,
        "1 / d^2 without a nearest distance",
        "kernels/shadow.py",
        "                d = wp.max(distance, wp.max(light.radius, MIN_DISTANCE))\n",
        "                d = distance\n",
        "tests/test_shadow.py::test_at_the_light_itself",
    ),
    Mutation(
        10,
        "the printed shader's plain lerp: weight two at alpha = -1",
        "kernels/relight.py",
        "    weight = wp.min(wp.abs(alpha), 1.0)\n",
        "    weight = wp.min(alpha, 1.0)\n",
        "tests/test_relight.py::test_paper_is_exact_at_its_three_cases",
    ),
    Mutation(
        11,
        "boxes look one row too far up",
        "kernels/summed_area.py",
        "        total -= table[r0 - 1, c1 - 1]\n",
        "        total -= table[r0, c1 - 1]\n",
        f"{HARD}test_rows11_12_exposure.py::test_any_box_of_any_frame",
    ),
    Mutation(
        12,
        "exposures above 1 are taken for 1",
        "kernels/exposure.py",
        "    scale_out[0] = wp.where(params[0].exposure_scale > 0.0, params[0].exposure_scale, 0.0)\n",
        "    scale_out[0] = wp.clamp(params[0].exposure_scale, 0.0, 1.0)\n",
        f"{HARD}test_rows11_12_exposure.py::test_exposures_at_their_ends",
    ),
    Mutation(
        13,
        "the BVH's boxes are not enlarged: rays slip through shared edges",
        "warp_ar/ray_scene.py",
        "2.0**-18",
        "0.0",
        f"{HARD}test_rows13_14_rays.py::test_the_20480_triangle_sphere_never_leaks",
    ),
    Mutation(
        14,
        "a fixed offset of a tenth of a millimetre",
        "kernels/visibility.py",
        "                hit.error = ROUNDING * (8.0 * wp.max(wp.abs(hit.point)) + 32.0 * size)\n",
        "                hit.error = 1.0e-4\n",
        "tests/test_visibility.py::test_rays_that_leave_do_not_come_back",
    ),
    Mutation(
        15,
        "a lost marker is taken to be where it was",
        "warp_ar/pipeline.py",
        "lost = self._tracker is not None and pose is None",
        "lost = False",
        f"{HARD}test_rows15_16_input.py::test_lost_and_found_every_frame",
    ),
    Mutation(
        16,
        "any array is a frame",
        "warp_ar/pipeline.py",
        "image.shape != (height, width, 3) or image.dtype != np.uint8",
        "image.ndim != 3",
        f"{HARD}test_rows15_16_input.py::test_what_is_no_frame_is_refused_and_the_next_one_works",
    ),
    Mutation(
        17,
        "bands start one row late",
        "kernels/launch.py",
        "inputs=[start, *inputs]",
        "inputs=[start + (1 if start else 0), *inputs]",
        f"{HARD}test_row17_same_answer.py::test_run_to_run_and_in_any_bands",
    ),
    Mutation(
        18,
        "holes are filled by a mean that is not normalised",
        "kernels/environment.py",
        "                mean += (weight / total) * (wp.vec3(texel[0], texel[1], texel[2]) - mean)\n",
        "                mean += (weight / area) * (wp.vec3(texel[0], texel[1], texel[2]) - mean)\n",
        f"{HARD}test_row18_energy.py::test_a_constant_room_under_any_mask",
    ),
)


def passes(folder: pathlib.Path, test: str) -> bool:
    """Whether a test of the copy passes; a crash is red, an error of collection is no answer."""
    command = [sys.executable, "-m", "pytest", test, "-x", "-q", "-p", "no:cacheprovider"]
    environment = {**os.environ, "PYTHONPATH": str(folder)}
    run = subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True)
    if run.returncode > 1:
        raise RuntimeError(f"{test} could not be run:\n{run.stdout[-3000:]}{run.stderr[-2000:]}")
    return run.returncode == 0


def try_mutation(folder: pathlib.Path, mutation: Mutation) -> str:
    """``caught``, or what is wrong with the mutation or its test."""
    file = folder / mutation.file
    text = file.read_text()
    if text.count(mutation.old) != 1:
        return f"STALE: the text occurs {text.count(mutation.old)} times in {mutation.file}"
    if not passes(folder, mutation.test):
        return "RED WITHOUT IT"
    file.write_text(text.replace(mutation.old, mutation.new))
    try:
        return "MISSED" if passes(folder, mutation.test) else "caught"
    finally:
        file.write_text(text)


def main() -> int:
    parser = argparse.ArgumentParser(description="Break the code on purpose and see the tests turn red.")
    parser.add_argument("rows", nargs="*", type=int, metavar="ROW", help="rows of the atlas; all if left out")
    options = parser.parse_args()
    chosen = [mutation for mutation in MUTATIONS if not options.rows or mutation.row in options.rows]
    missed = 0
    with tempfile.TemporaryDirectory() as place:
        folder = pathlib.Path(place) / "copy"
        folder.mkdir()
        for name in COPIED:
            source = ROOT / name
            if source.is_dir():
                ignore = shutil.ignore_patterns("__pycache__")
                shutil.copytree(source, folder / name, symlinks=True, ignore=ignore)
            else:
                shutil.copy(source, folder / name)
        for mutation in chosen:
            answer = try_mutation(folder, mutation)
            missed += answer != "caught"
            print(f"{mutation.row:>3}  {answer:<7}  {mutation.what}  [{mutation.test}]", flush=True)
    return 1 if missed else 0


if __name__ == "__main__":
    sys.exit(main())
