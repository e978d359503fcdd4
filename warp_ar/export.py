"""``python -m warp_ar.export SCENE --output shot.usda``: exports camera, surfaces and lights of a shot."""

from __future__ import annotations

if __name__ == "__main__":
    from warp_ar.begin import begin

    begin("warp_ar.export")

import argparse
import dataclasses
import glob
import itertools
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from warp_ar.begin import importing
from warp_ar.command_line import EXIT_DONE, Parser, ending, run_command
from warp_ar.errors import SinkError, SourceError, UsageError, say
from warp_ar.output.camera_files import TRACK_SUFFIX, distort_map, undistort_map, write_stmap, write_track
from warp_ar.output.environment_file import write_environment
from warp_ar.output.gltf_file import GLTF_SUFFIX, write_glb
from warp_ar.output.places import claim_places, reads_of
from warp_ar.output.shot import Shot, texture_files
from warp_ar.output.usd_file import USD_SUFFIXES, write_usd
from warp_ar.scene import Scene, load_scene
from warp_ar.scene.pose_file import load_usd
from warp_ar.signature import is_signed

SUFFIXES = (*USD_SUFFIXES, GLTF_SUFFIX, TRACK_SUFFIX)


def make_parser() -> argparse.ArgumentParser:
    """Return the parser of the command's options."""
    parser = Parser(
        prog="python -m warp_ar.export",
        description="Write a scene and its camera's path as USD, glTF, or OpenTrackIO (.jsonl).",
    )
    add = parser.add_argument
    add("scene", metavar="SCENE", help="scene file, its folder, or a bundled scene's name")
    add("--output", type=ending(*SUFFIXES), required=True, metavar="FILE", help=f"ends in {', '.join(SUFFIXES)}")
    parser.add_common("--source", "--calibration", "--frames", "--device", "--overwrite")
    text = "write camera, surfaces and virtual lights only"
    add("--no-environment", action="store_true", help=text)
    text = "also write the lens's STMaps, FILE_undistort.exr and FILE_distort.exr"
    add("--stmaps", action="store_true", help=text)
    return parser


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; returns its exit code."""
    return run_command(lambda: export(make_parser().parse_args(arguments)), (SinkError, SourceError))


def export(options: argparse.Namespace) -> int:
    """Track the marker in all frames, take the light of the last frame, and write the shot.

    Raises:
        SinkError: The output cannot be written.
        SceneError: The scene cannot be used.
        SourceError: The frames cannot be read, or none shows a marker.
        UsageError: The output has another ending, an option makes no sense, or a library is missing.
    """
    output: Path = options.output
    if output.suffix.lower() in USD_SUFFIXES:
        load_usd()
    scene = load_scene(options.scene)
    maps = environment_names(scene)
    side_files = {name: output.with_name(f"{output.stem}_{name}.exr") for name in (*maps, "undistort", "distort")}
    if options.no_environment or output.suffix.lower() == TRACK_SUFFIX:
        side_files = {name: path for name, path in side_files.items() if name not in maps}
    if not options.stmaps:
        del side_files["undistort"], side_files["distort"]
    textures = texture_files(scene, output) if output.suffix.lower() in USD_SUFFIXES else {}
    writes = {"--output": output, **{f"--output's {name}": path for name, path in {**side_files, **textures}.items()}}
    claim_places(reads_of(scene, options), writes, overwrite=options.overwrite)
    shot, light = _read_shot(options, scene)
    side_files = {name: path for name, path in side_files.items() if name not in maps[len(light) :]}
    for name, radiance in zip(maps, light, strict=False):
        write_environment(side_files[name], radiance, overwrite=True, axes="y-up")
    if light:
        _clear_stale(output, len(light))
        others = tuple(
            (side_files[name], scene.probes[ball].center) for ball, name in enumerate(maps[: len(light)]) if ball
        )
        shot = dataclasses.replace(shot, environment=side_files[maps[0]], radiance=light[0], others=others)
    for name, make in (("undistort", undistort_map), ("distort", distort_map)):
        if name in side_files:
            write_stmap(side_files[name], make(shot.camera))
    write = {GLTF_SUFFIX: write_glb, TRACK_SUFFIX: write_track}.get(output.suffix.lower(), write_usd)
    written = write(output, shot)
    lost = sum(pose is None for pose in shot.poses)
    print(f"{len(shot.poses)} frames" + (f", {lost} without a pose" if lost else ""))
    for path in (*written, *side_files.values()):
        print(path)
    return EXIT_DONE


def environment_names(scene: Scene) -> tuple[str, ...]:
    """Return the endings of the environments' files: of the first mirror ball, then of each further one."""
    return ("environment", *(f"environment_{ball}" for ball in range(1, len(scene.probes))))


def _clear_stale(output: Path, balls: int) -> None:
    """Remove environment files that an earlier export of more mirror balls wrote and this one does not write."""
    for path in output.parent.glob(f"{glob.escape(output.stem)}_environment_[1-9]*.exr"):
        number = path.stem.removeprefix(f"{output.stem}_environment_")
        if number.isdecimal() and int(number) >= balls and is_signed(path):
            path.unlink(missing_ok=True)
            say(f"{path}: removed; an earlier export wrote it for a mirror ball that this scene lacks")


def _read_shot(options: argparse.Namespace, scene: Any) -> tuple[Shot, tuple[Any, ...]]:
    """Return the camera's path and the environments of the last frame that shows them."""
    with importing():
        from warp_ar.session import Session  # loads Warp

    light = not options.no_environment and bool(scene.probes or scene.captured)
    light = light and options.output.suffix.lower() != TRACK_SUFFIX
    outputs = ("pose", "environment") if light else ("pose",)
    poses: list[Any] = []
    captured: tuple[Any, ...] = ()
    with Session(
        scene, source=options.source, calibration=options.calibration, device=options.device, outputs=outputs
    ) as session:
        fps = session.source.fps
        if session.source.live:
            raise UsageError("a live camera's frames have no end; record them first, and export the file")
        for _, result in itertools.islice(session, options.frames):
            poses.append(result.pose)
            captured = (light and result.environments) or captured
        camera = session.scene.camera.scaled_to(*session.source.size)
        lit = dataclasses.replace(session.scene, camera=camera)
    if all(pose is None for pose in poses):
        raise SourceError("no frame shows the marker, so the camera's path is unknown; see python -m warp_ar.doctor")
    path = options.source if options.source is not None else lit.source.path if lit.source is not None else None
    plate = None if path is None else Path(os.path.relpath(path, options.output.parent))
    return Shot(lit, fps, tuple(poses), plate), captured
