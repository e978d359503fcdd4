"""Would the suite notice? For every row of the atlas two deliberate breaks or more, and the test that must turn red.

    python -m tests.hard_cases.mutations [ROW ...] [--jobs N]

copies the checkout to a temporary folder, and there, one after another: runs the row's test, which must pass; breaks
the code by replacing one piece of text; runs the test again, which must fail; mends it. The checkout stays as it is.
Prints a table of the answers at the end.
"""

from __future__ import annotations

import argparse
import dataclasses
import os
import pathlib
import queue
import shutil
import subprocess
import sys
import tempfile
import threading
from collections.abc import Sequence

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
        "kernels/environment/unwrap.py",
        "            side = any_perpendicular(axis)\n        side = wp.normalize(side)\n",
        "            pass\n        side = side / wp.length(side)\n",
        f"{HARD}test_rows01_03_probe.py::test_light_straight_back_along_an_axis",
    ),
    Mutation(
        1,
        "the ball shows what lies along its normals",
        "kernels/picture/declip.py",
        "wi = direction - 2.0 * wp.dot(direction, normal) * normal",
        "wi = normal",
        "tests/test_declip.py::test_ball_pixel_off_the_middle_shows_what_it_mirrors",
    ),
    Mutation(
        1,
        "what leaves the mirror ball starts on it, not off it: at the rim it meets the ball again",
        "kernels/receiver/mirror_ball.py",
        "        out.origin = offset_origin(point, normal, out.wi, error)\n",
        "        out.origin = point\n",
        "tests/test_mirror_ball.py::test_grazing_the_silhouette",
    ),
    Mutation(
        2,
        "orthographic unwrapping: the reflected ray of a camera at infinity",
        "kernels/environment/unwrap.py",
        "        toward = wp.vec2(distance - n[0], -n[1])\n",
        "        toward = wp.vec2(1.0e6, 0.0)\n",
        "tests/test_unwrap.py::test_normals_reflect_every_direction_to_the_camera",
    ),
    Mutation(
        2,
        "what the camera sees is infinitely far from the ball",
        "kernels/picture/declip.py",
        "share = NEAREST * wp.float32(step) / wp.float32(STEPS)",
        "share = wp.float32(0.0)",
        "tests/test_declip.py::test_lamp_beyond_the_scene_is_found_at_its_distance",
    ),
    Mutation(
        3,
        "samples outside the frame count",
        "kernels/environment/unwrap.py",
        "            if inside >= 0.0 and ramp > 0.0:\n",
        "            if at[2] > rim[0]:\n"
        "                ramp = 1.0\n"
        "                at[0] = wp.clamp(at[0], 0.0, last_column)\n"
        "                at[1] = wp.clamp(at[1], 0.0, last_row)\n",
        "tests/test_unwrap.py::test_partly_outside_the_frame",
    ),
    Mutation(
        3,
        "surfaces beyond the frame are read at its border",
        "kernels/recovery/recover.py",
        "clear = at[2] > 0.0 and i >= 0 and j >= 0 and i < frame.shape[0] and j < frame.shape[1]",
        "i = wp.clamp(i, 0, frame.shape[0] - 1)\n                    j = wp.clamp(j, 0, frame.shape[1] - 1)\n"
        "                    clear = at[2] > 0.0",
        "tests/test_recover.py::test_observation_reads_surfaces_and_nothing_else",
    ),
    Mutation(
        3,
        "a camera inside the ball sees it mirror the environment",
        "kernels/receiver/mirror_ball.py",
        "        if wp.dot(normal, direction) >= 0.0:\n            return out",
        "        if wp.dot(normal, direction) >= 0.0:\n            normal = -normal",
        "tests/test_mirror_ball.py::test_a_camera_inside_the_ball_sees_no_mirror",
    ),
    Mutation(
        4,
        "half a texel's shift in every look-up of a packed level",
        "kernels/environment/pyramid.py",
        "    y = row - 0.5\n    x = column - 0.5\n    i = wp.int32(wp.floor(y))",
        "    y = row - 0.5\n    x = column\n    i = wp.int32(wp.floor(y))",
        "tests/test_pyramid.py::test_sampling_follows_a_ramp_without_a_shift",
    ),
    Mutation(
        4,
        "what clips beyond the seam is not seen from this side of it",
        "kernels/environment/bracket.py",
        "(j + offset + width) % width",
        "wp.clamp(j + offset, 0, width - 1)",
        "tests/test_bracket.py::test_around_a_lamp_one_exposure_has_the_say",
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
        5,
        "the angle to the pole by acos",
        "kernels/latlong.py",
        "    theta = wp.atan2(radial, direction[2])\n",
        "    theta = wp.acos(direction[2])\n",
        "tests/test_latlong.py::test_coordinates_of_poles_and_of_more_than_unit_length",
    ),
    Mutation(
        6,
        "negative light accumulates",
        "kernels/safe_math.py",
        "    if wp.min(radiance) < 0.0:\n        return 0.0\n",
        "",
        f"{HARD}test_row06_garbage.py::test_what_is_no_light_is_gone_with_its_frame",
    ),
    Mutation(
        6,
        "filters take texels as they are",
        "kernels/safe_math.py",
        "    if value > 0.0:  # false for NaN\n        return wp.min(value, MAX_RADIANCE)\n    return 0.0\n",
        "    return value\n",
        f"{HARD}test_row06_garbage.py::test_any_map_gives_finite_light",
    ),
    Mutation(
        6,
        "averages take in what stands beside an object",
        "kernels/objects/near_field.py",
        "if objects[i + a, j + b] == found:",
        "if objects[i + a, j + b] >= -1:",
        "tests/test_near_field.py::test_averages_stop_at_the_edges_of_objects",
    ),
    Mutation(
        6,
        "the ball takes on the shadows of what it hides, not of what it mirrors",
        "kernels/receiver/mirror_ball.py",
        "look_up_layer(shadow_ratio, at[0], at[1])",
        "shadow_ratio[i, j]",
        "tests/test_mirror_ball.py::test_a_broken_shadow_reaches_only_what_mirrors_its_place",
    ),
    Mutation(
        7,
        "a running mean that loses a little every frame",
        "kernels/environment/accumulate.py",
        "        m = m + a * wp.cw_mul(wp.vec3(1.0, 1.0, 1.0) - beyond, x - m)\n",
        "        m = 0.99999 * m + a * wp.cw_mul(wp.vec3(1.0, 1.0, 1.0) - beyond, x - m)\n",
        "tests/test_accumulate.py::test_no_drift_over_ten_thousand_frames",
    ),
    Mutation(
        7,
        "a scale that became NaN stays NaN",
        "kernels/picture/expose.py",
        "    if before > 0.0:\n        aim = before",
        "    if before != 0.0:\n        aim = before",
        f"{HARD}test_row07_accumulation.py::test_an_automatic_exposure_that_was_spoilt_heals",
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
        8,
        "a mirror's level by the logarithm of its width",
        "kernels/environment/lobes.py",
        "    if alpha < narrowest:\n        return wp.max(alpha, 0.0) / narrowest\n",
        "",
        "tests/test_prefilter.py::test_levels_grow_with_roughness_and_fall_with_shininess",
    ),
    Mutation(
        9,
        "1 / d^2 without a nearest distance",
        "kernels/rays/shadow.py",
        "                d = wp.max(distance, wp.max(light.radius, MIN_DISTANCE))\n",
        "                d = distance\n",
        "tests/test_shadow.py::test_at_the_light_itself",
    ),
    Mutation(
        9,
        "a cone whose angles are equal divides by their difference",
        "kernels/rays/shadow.py",
        "    if angle <= light.inner_angle:\n        return 1.0\n"
        "    if angle >= light.outer_angle:\n        return 0.0\n",
        "",
        "tests/test_shadow.py::test_cone_angles_at_their_ends",
    ),
    Mutation(
        10,
        "the printed shader's plain lerp: weight two for the flat term at alpha = -1",
        "kernels/receiver/receiver.py",
        "    weight = wp.min(wp.abs(alpha), 1.0)\n",
        "    weight = wp.min(alpha, 1.0)\n",
        "tests/test_relight.py::test_paper_in_its_three_cases_by_hand",
    ),
    Mutation(
        10,
        "the strongest light of an even environment dominates it",
        "kernels/environment/key_lights.py",
        "light.directionality = alone * wp.clamp(2.0 * wp.dot(flow, light.direction) / all[3], 0.0, 1.0)",
        "light.directionality = alone",
        "tests/test_key_lights.py::test_a_lamp_in_a_uniform_environment_dominates_by_twice_its_share",
    ),
    Mutation(
        11,
        "boxes look one row too far up",
        "kernels/picture/summed_area.py",
        "        total -= table[r0 - 1, c1 - 1]\n",
        "        total -= table[r0, c1 - 1]\n",
        f"{HARD}test_rows11_12_exposure.py::test_any_box_of_any_frame",
    ),
    Mutation(
        11,
        "what lies beyond the frame counts as black",
        "kernels/picture/summed_area.py",
        "wp.float32(wp.max((r1 - r0) * (c1 - c0), 1))",
        "wp.float32(size * size)",
        f"{HARD}test_rows11_12_exposure.py::test_a_white_frame_of_any_size_fades_evenly",
    ),
    Mutation(
        12,
        "exposures above 1 are taken for 1",
        "kernels/picture/expose.py",
        "    scale_out[0] = wp.where(params[0].exposure_scale > 0.0, params[0].exposure_scale, 0.0)\n",
        "    scale_out[0] = wp.clamp(params[0].exposure_scale, 0.0, 1.0)\n",
        f"{HARD}test_rows11_12_exposure.py::test_exposures_at_their_ends",
    ),
    Mutation(
        12,
        "a clipped channel is estimated below clipping",
        "kernels/picture/declip.py",
        "wp.clamp(k * hue[channel], radiance[channel], BRIGHTEST)",
        "wp.min(k * hue[channel], BRIGHTEST)",
        "tests/test_declip.py::test_never_below_clipping",
    ),
    Mutation(
        13,
        "the BVH's boxes are not enlarged: rays slip through shared edges",
        "warp_ar/scene/ray_mesh.py",
        "2.0**-18",
        "0.0",
        f"{HARD}test_rows13_14_rays.py::test_the_20480_triangle_sphere_never_leaks",
    ),
    Mutation(
        13,
        "what a proxy hides is looked up in the picture",
        "kernels/objects/reflect.py",
        "        if occluded_by_proxies(scene, params.camera_position, from_camera, 1.0 - HIDDEN_MARGIN):\n"
        "            return nowhere\n",
        "",
        "tests/test_reflect.py::test_what_a_proxy_hides_is_not_in_the_picture",
    ),
    Mutation(
        13,
        "faces turned away are looked up in the picture",
        "kernels/objects/reflect.py",
        "        if wp.dot(from_camera, hit.geometric_normal) >= 0.0:\n            return nowhere\n",
        "",
        "tests/test_reflect.py::test_a_face_turned_away_is_not_in_the_picture",
    ),
    Mutation(
        13,
        "another ball beyond what is mirrored hides it",
        "kernels/receiver/mirror_ball.py",
        "nearest_ball(receiver.probes, start, wi, reach)",
        "nearest_ball(receiver.probes, start, wi, FAR)",
        "tests/test_mirror_ball.py::test_a_ball_behind_what_is_mirrored_hides_nothing",
    ),
    Mutation(
        13,
        "rays that leave a box's middle behind are taken to miss it",
        "kernels/receiver/receiver_cells.py",
        "    return beside <= 0.0 or (along > 0.0 and along * along > beside)\n",
        "    return along > 0.0 and along * along > beside\n",
        "tests/test_receiver_cells.py::test_the_end_of_a_long_box_is_not_passed_by",
    ),
    Mutation(
        14,
        "a fixed offset of ten micrometres where surfaces look at the environment",
        "kernels/recovery/recover.py",
        "                origin = offset_origin(point.position, point.normal, middle, error)\n",
        "                origin = point.position + 1.0e-5 * point.normal\n",
        f"{HARD}test_rows13_14_rays.py::test_surfaces_receive_the_same_light_at_any_scale_and_place",
    ),
    Mutation(
        14,
        "a fixed offset of a tenth of a millimetre",
        "kernels/rays/trace.py",
        "                hit.error = ROUNDING * (8.0 * wp.max(wp.abs(hit.point)) + 32.0 * size)\n",
        "                hit.error = 1.0e-4\n",
        "tests/test_visibility.py::test_rays_that_leave_do_not_come_back",
    ),
    Mutation(
        15,
        "a lost marker is taken to be where it was",
        "warp_ar/engine/pipeline.py",
        "lost = pose is None and (self._tracker is not None or isinstance(given, Track))",
        "lost = False",
        f"{HARD}test_rows15_16_input.py::test_lost_and_found_every_frame",
    ),
    Mutation(
        15,
        "of a plane's two poses the one that fits this frame better",
        "warp_ar/tracking/tracking.py",
        "        if guess is None or len(fits) < 2:\n",
        "        if True:\n",
        "tests/test_tracking.py::test_pose_does_not_flip",
    ),
    Mutation(
        15,
        "of two markers with one number the first in the list",
        "warp_ar/tracking/tracking.py",
        "for d in sorted(found, key=rank):",
        "for d in found:",
        "tests/test_tracking.py::test_two_with_one_id",
    ),
    Mutation(
        16,
        "any array is a frame",
        "warp_ar/engine/frame_exchange.py",
        "if image.shape != expected or image.dtype != np.uint8:",
        "if image.ndim != 3:",
        f"{HARD}test_rows15_16_input.py::test_what_is_no_frame_is_refused_and_the_next_one_works",
    ),
    Mutation(
        16,
        "frames of a folder may have any size",
        "warp_ar/sources/frame_folder.py",
        "            check_size(image, self.size, str(path), index)\n",
        "",
        "tests/test_sources.py::test_size_that_changes_is_named",
    ),
    Mutation(
        16,
        "of 16 bits the upper 8",
        "warp_ar/sources/frame_folder.py",
        "((picture.astype(np.uint32) + 128) // 257).astype(np.uint8)",
        "(picture >> 8).astype(np.uint8)",
        "tests/test_sources.py::test_grey_alpha_and_16_bit_become_rgb",
    ),
    Mutation(
        17,
        "bands start one row late",
        "kernels/launch.py",
        "inputs=[start, *inputs]",
        "inputs=[start + (1 if start else 0), *inputs]",
        f"{HARD}test_row17_same_answer.py::test_run_to_run_and_in_any_bands[cpu-visibility-default]",
    ),
    Mutation(
        17,
        "bands leave out a row between them",
        "kernels/bands.py",
        "p.taken = stop;",
        "p.taken = stop + (stop < p.stop);",
        f"{HARD}test_row17_same_answer.py::test_bands_of_threads",
    ),
    Mutation(
        17,
        "patches that the light has left still send it",
        "kernels/receiver/receiver_cells.py",
        "range(rect[0] / patch_stride, wp.min((rect[1] - 1) / patch_stride + 1, patches.shape[0]))",
        "range(patches.shape[0])",
        "tests/test_receiver_cells.py::test_nothing_of_an_earlier_frame_is_read",
    ),
    Mutation(
        18,
        "objects read a part of a list as if it were drawn",
        "warp_ar/stages/near_field.py",
        'arrays["environment_samples"] if config.distant',
        'arrays["environment_samples_texels"] if config.distant',
        f"{HARD}test_row18_energy.py::test_what_surrounds_a_white_object_is_white",
    ),
    Mutation(
        18,
        "objects that take light from the desk give none back",
        "kernels/receiver/environment_shadow_bounce.py",
        "out.sent += weight * light.distant\n",
        "out.sent += 0.0 * light.distant\n",
        f"{HARD}test_row18_energy.py::test_white_objects_give_back_the_light_that_they_take",
    ),
    Mutation(
        18,
        "mirrored objects are laid over what the ball showed, not put in its place",
        "kernels/receiver/mirror_ball.py",
        "change.first = wp.cw_mul(rho, radiance) - shown",
        "change.first = wp.cw_mul(rho, radiance)",
        f"{HARD}test_row18_energy.py::test_white_objects_in_a_white_ball_change_nothing",
    ),
    Mutation(
        18,
        "holes are filled by a mean that is not normalised",
        "kernels/environment/fill.py",
        "                mean += (weight / total) * (value - mean)\n",
        "                mean += (weight / area) * (value - mean)\n",
        f"{HARD}test_row18_energy.py::test_a_constant_environment_under_any_mask",
    ),
)


CAUGHT = "caught"


def passes(folder: pathlib.Path, test: str) -> bool:
    """Whether a test of the copy passes; a crash is red, an error of collection is no answer."""
    command = [sys.executable, "-m", "pytest", test, "-x", "-q", "-p", "no:cacheprovider", "-p", "no:xdist"]
    environment = {**os.environ, "PYTHONPATH": str(folder)}
    run = subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True)
    if run.returncode > 1:
        raise RuntimeError(f"{test} could not be run:\n{run.stdout[-3000:]}{run.stderr[-2000:]}")
    return run.returncode == 0


def try_mutation(folder: pathlib.Path, mutation: Mutation) -> str:
    """``CAUGHT``, or what is wrong with the mutation or its test."""
    file = folder / mutation.file
    text = file.read_text()
    if text.count(mutation.old) != 1:
        return f"STALE: the text occurs {text.count(mutation.old)} times in {mutation.file}"
    if not passes(folder, mutation.test):
        return "RED WITHOUT IT"
    file.write_text(text.replace(mutation.old, mutation.new))
    try:
        return "MISSED" if passes(folder, mutation.test) else CAUGHT
    finally:
        file.write_text(text)


def copy_checkout(folder: pathlib.Path) -> None:
    """All that tests need."""
    folder.mkdir()
    for name in COPIED:
        source = ROOT / name
        if source.is_dir():
            shutil.copytree(source, folder / name, symlinks=True, ignore=shutil.ignore_patterns("__pycache__"))
        else:
            shutil.copy(source, folder / name)


def try_all(mutations: Sequence[Mutation], jobs: int) -> list[str]:
    """Answers in the order of the mutations; every worker breaks a copy of its own."""
    answers = [""] * len(mutations)
    waiting: queue.SimpleQueue[int] = queue.SimpleQueue()
    for index in range(len(mutations)):
        waiting.put(index)

    def work(folder: pathlib.Path) -> None:
        copy_checkout(folder)
        while True:
            try:
                index = waiting.get_nowait()
            except queue.Empty:
                return
            try:
                answers[index] = try_mutation(folder, mutations[index])
            except RuntimeError as error:
                answers[index] = f"ERROR: {error}"
            print(f"{sum(map(bool, answers))}/{len(mutations)}  {answers[index]}: {mutations[index].what}", flush=True)

    with tempfile.TemporaryDirectory() as place:
        threads = [
            threading.Thread(target=work, args=(pathlib.Path(place) / str(number),))
            for number in range(min(jobs, len(mutations)))
        ]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
    return answers


def main() -> int:
    parser = argparse.ArgumentParser(description="Break the code on purpose and see the tests turn red.")
    parser.add_argument("rows", nargs="*", type=int, metavar="ROW", help="rows of the atlas; all if left out")
    parser.add_argument("--jobs", type=int, default=1, metavar="N", help="breaks to try at once (default: 1)")
    options = parser.parse_args()
    if unknown := set(options.rows) - {mutation.row for mutation in MUTATIONS}:
        parser.error(f"the atlas has no row {min(unknown)}; expected 1 to {max(m.row for m in MUTATIONS)}")
    chosen = [mutation for mutation in MUTATIONS if not options.rows or mutation.row in options.rows]
    answers = try_all(chosen, options.jobs)
    print("\n| row | break | test | answer |\n| --- | --- | --- | --- |")
    for mutation, answer in zip(chosen, answers, strict=True):
        test = mutation.test.removeprefix("tests/").removeprefix("hard_cases/")
        print(f"| {mutation.row} | {mutation.what} | {test} | {answer.splitlines()[0]} |")
    caught = answers.count(CAUGHT)
    print(f"\n{caught} of {len(chosen)} caught")
    return 0 if caught == len(chosen) else 1


if __name__ == "__main__":
    sys.exit(main())
