"""Render the clips of the bundled scenes with Mitsuba 3, and path-traced truth for them.

    python scenes/make_clips.py [--clip desk] [--variant cuda_ad_rgb] [--frames N] [--spp 512] [--out scenes/clips]
    python scenes/make_clips.py --truth FOLDER [--scene torus] [--frames N]
    python scenes/make_clips.py --bundle [--scene torus] [--spp 512]

A clip is what a camera would have seen: one environment, one desk, a printed marker, a mirror ball, and clutter that no
scene file mentions. Everything is made here, in code: geometry, textures, light. Radiance is in camera values
throughout (1 clips), so no exposure is applied: a frame is clipped at 1, sRGB-encoded and rounded to 8 bit.

The virtual objects are never in a clip. ``--truth`` reads them from the scene file and renders the same frames with the
objects, the lights, or both, really there; also the frames at half the exposure and the light arriving at the ball's
centre. ``--bundle`` writes one frame of each scene as ``truth/SCENE_NNNN.png``, transparent wherever the virtual
objects (or the clipping that a shorter exposure undoes) change nothing: what ``warp_ar.tradeoff`` compares pictures
with.

Needs the extra ``assets``. ``cuda_ad_rgb`` takes about a second per frame; ``llvm_ad_rgb`` works on any CPU, slowly,
and wants LLVM 19 (DRJIT_LIBLLVM_PATH names the library; 16 and 22 do not compile the scene ``torus``). Open Image
Denoise takes off the last noise.
"""

from __future__ import annotations

import argparse
import json
import pathlib
import tempfile
import time
import tomllib
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import av
import cv2
import mitsuba as mi
import numpy as np
import pyoidn
from make_desk import BALL, clutter, environment, essentials
from make_shapes import Dict
from make_virtual import HERE, virtual_light, virtual_object

WIDTH, HEIGHT, FOCAL, FPS = 640, 480, 640.0, 24
PATH = {"type": "path", "max_depth": 8, "rr_depth": 4}
"""Path tracing up to seven bounces: what more would add is below a grey level in an environment this bright."""
PASS_SPP = 16
"""Samples per pixel that are taken at a time: 128 at once need more memory than 16 GiB."""
GUIDE_SPP = 32
"""Samples per pixel of the albedo and the normals that guide the denoiser: they need to resolve edges, not light."""


def ease(t: float, start: float, stop: float) -> float:
    """Return 0 before ``start``, 1 after ``stop``, and a smooth rise between, at time ``t``."""
    s = float(np.clip((t - start) / (stop - start), 0, 1))
    return s * s * (3 - 2 * s)


def orbit(
    azimuth: float, distance: float, height: float, target: tuple[float, float, float]
) -> tuple[np.ndarray, np.ndarray]:
    """Return the position of a camera and the point that it looks at, metres.

    The camera has the horizontal ``distance`` from ``target`` and the height ``height``. At azimuth 0 degrees it looks
    along +y.
    """
    a = np.radians(azimuth)
    return np.array([target[0] + distance * np.sin(a), target[1] - distance * np.cos(a), height]), np.array(target)


def desk_camera(t: float) -> tuple[np.ndarray, np.ndarray]:
    s = ease(t, 0, 1)
    return orbit(
        -16 + 40 * s,
        0.62 - 0.05 * np.sin(np.pi * t),
        0.42 + 0.05 * np.sin(2 * np.pi * t),
        (0.03, 0.03 - 0.01 * s, 0.025),
    )


def wire_camera(t: float) -> tuple[np.ndarray, np.ndarray]:
    return orbit(-10 + 24 * ease(t, 0, 1), 0.54, 0.46 - 0.04 * t, (0.03, 0.0, 0.0))


def darken_camera(t: float) -> tuple[np.ndarray, np.ndarray]:
    return orbit(8 - 20 * ease(t, 0, 1), 0.74, 0.4 + 0.02 * np.sin(2 * np.pi * t), (0.02, 0.08, 0.06))


@dataclass(frozen=True)
class Clip:
    """One clip: its length, its camera and how its lamps change."""

    frames: int
    """Number of frames at 24 per second."""
    camera: Callable[[float], tuple[np.ndarray, np.ndarray]]
    """Function from time, 0 to 1, to the camera's position and the point that it looks at, world metres."""
    levels: Callable[[float], dict[str, float]]
    """Function from time, 0 to 1, to the factor on each lamp's radiance."""


def desk_levels(t: float) -> dict[str, float]:
    """Return factors on lamps' radiance: a cloud passes, dusk falls, the ceiling lamp comes up, daylight returns."""
    cloud = 1 - 0.25 * np.sin(np.pi * ease(t, 0.08, 0.3)) ** 2
    return {
        "window": cloud * (1 - 0.8 * ease(t, 0.36, 0.5) + 0.8 * ease(t, 0.82, 0.97)),
        "ceiling_lamp": ease(t, 0.46, 0.58) * (1 - 0.6 * ease(t, 0.84, 0.98)),
    }


CLIPS = {
    "desk": Clip(120, desk_camera, desk_levels),
    "wire": Clip(72, wire_camera, lambda t: {"window": 1.0, "table_lamp": 1.0}),
    "darken": Clip(72, darken_camera, lambda t: {"window": 1.0, "globe": 1.0}),
}
SCENES = {
    "desk": "desk",
    "torus": "desk",
    "mirror": "desk",
    "product": "desk",
    "screen": "desk",
    "wire_coincident": "wire",
    "wire_opposing": "wire",
    "darken": "darken",
}
"""The clip that each bundled scene plays."""
BUNDLED = {
    "desk": 24,
    "torus": 84,
    "mirror": 24,
    "product": 108,
    "screen": 60,
    "wire_coincident": 36,
    "wire_opposing": 36,
    "darken": 36,
}
"""Number of the frame of each scene whose truth is bundled. The light of the last three scenes does not change."""


class Renderer:
    """One Mitsuba scene whose camera and lamps move."""

    def __init__(self, clip: str, spp: int, virtual: Dict | None = None, with_ball: bool = True) -> None:
        self.clip, self.spp = clip, spp
        with tempfile.TemporaryDirectory() as name:
            folder = pathlib.Path(name)
            content = environment(clip) | essentials(clip, with_ball) | clutter(clip, folder)
            for k, item in enumerate((virtual or {}).get("object", [])):
                made = virtual_object(item, folder)
                content |= (
                    {f"object{k}": made}
                    if "type" in made
                    else {f"object{k}_{name}": part for name, part in made.items()}
                )
            for k, light in enumerate((virtual or {}).get("light", [])):
                content[f"light{k}"] = virtual_light(light)
            self.scene = mi.load_dict({"type": "scene", **content})
        self.integrator = mi.load_dict(PATH)
        self.guides = mi.load_dict({"type": "aov", "aovs": "albedo:albedo,normal:sh_normal"})
        self.lamps = mi.traverse(self.scene)
        self.base = {}
        for lamp in CLIPS[clip].levels(0.0):
            key = next(
                k for k in (f"{lamp}.emitter.radiance.data", f"{lamp}.emitter.radiance.value") if k in self.lamps
            )
            self.base[lamp] = (key, type(self.lamps[key])(self.lamps[key]))

    def light(self, t: float) -> None:
        """Set every lamp to its level at time ``t``."""
        for lamp, level in CLIPS[self.clip].levels(t).items():
            key, value = self.base[lamp]
            self.lamps[key] = value * float(level)
        self.lamps.update()

    def frame(self, t: float, seed: int) -> np.ndarray:
        """Return the picture at time ``t`` in linear camera values, ``(HEIGHT, WIDTH, 3)``."""
        self.light(t)
        eye, target = CLIPS[self.clip].camera(t)
        sensor = mi.load_dict(
            {
                "type": "perspective",
                "fov": float(np.degrees(2 * np.arctan(WIDTH / 2 / FOCAL))),
                "fov_axis": "x",
                "near_clip": 0.01,
                "to_world": mi.ScalarTransform4f().look_at(origin=list(eye), target=list(target), up=[0, 0, 1]),
                "film": {
                    "type": "hdrfilm",
                    "width": WIDTH,
                    "height": HEIGHT,
                    "pixel_format": "rgb",
                    "rfilter": {"type": "box"},
                },
                "sampler": {"type": "independent"},
            }
        )
        passes = -(-self.spp // PASS_SPP)
        shots = (
            mi.render(self.scene, sensor, integrator=self.integrator, spp=self.spp // passes, seed=seed + 7919 * k)
            for k in range(passes)
        )
        color = sum(map(np.array, shots)) / passes
        guides = np.array(mi.render(self.scene, sensor=sensor, integrator=self.guides, spp=GUIDE_SPP, seed=seed))
        albedo, normal = np.clip(guides[..., -6:-3], 0, 1), guides[..., -3:]
        return pyoidn.denoise(color, albedo=albedo, normal=np.ascontiguousarray(normal), hdr=True)

    def environment(self, t: float, height: int = 256, rounds: int = 64) -> np.ndarray:
        """Return the light that arrives at the ball's place, latlong ``(height, 2 height, 3)``; without the ball."""
        import drjit as dr

        self.light(t)
        integrator = mi.load_dict(PATH)
        count = height * height * 2
        total = np.zeros((count, 3))
        sampler = mi.load_dict({"type": "independent"})
        per_round = max(1, self.spp // rounds) if self.spp >= rounds else 1
        index = dr.arange(mi.UInt32, count * per_round) // per_round
        for k in range(min(rounds, self.spp)):
            sampler.seed(1000 + k, count * per_round)
            row = mi.Float(index // (2 * height)) + sampler.next_1d()
            column = mi.Float(index % (2 * height)) + sampler.next_1d()
            theta, phi = dr.pi * row / height, (column / height - 1) * dr.pi
            direction = mi.Vector3f(dr.sin(theta) * dr.cos(phi), dr.sin(theta) * dr.sin(phi), dr.cos(theta))
            rays = mi.RayDifferential3f(mi.Ray3f(mi.Point3f(*BALL), direction))
            radiance, _, _ = integrator.sample(self.scene, sampler, rays)
            total += np.array(radiance).T.reshape(count, per_round, 3).mean(1)
        return (total / min(rounds, self.spp)).reshape(height, 2 * height, 3).astype(np.float32)


def encode(linear: np.ndarray) -> np.ndarray:
    """Return 8-bit codes of linear values: clipped at 1, sRGB-encoded, rounded."""
    x = np.clip(linear, 0, 1)
    return np.round(np.where(x <= 0.0031308, 12.92 * x, 1.055 * x ** (1 / 2.4) - 0.055) * 255).astype(np.uint8)


def pose(clip: str, t: float) -> tuple[np.ndarray, np.ndarray]:
    """Return R and t that map marker-frame points X to camera points R X + t (OpenCV: x right, y down, z ahead)."""
    eye, target = CLIPS[clip].camera(t)
    ahead = (target - eye) / np.linalg.norm(target - eye)
    right = np.cross(ahead, [0, 0, 1])
    right /= np.linalg.norm(right)
    rotation = np.stack([right, np.cross(ahead, right), ahead])
    return rotation, -rotation @ eye


def write_video(path: pathlib.Path, images: Iterator[np.ndarray], crf: int) -> None:
    """Write pictures as H.264 video, 4:2:0, BT.709, with a key frame every second; ``crf`` is the encoder's quality."""
    with av.open(str(path), "w") as container:
        stream = container.add_stream("libx264", rate=FPS)
        stream.width, stream.height, stream.pix_fmt = WIDTH, HEIGHT, "yuv420p"
        stream.options = {"crf": str(crf), "preset": "veryslow", "g": str(FPS)}
        for image in images:
            container.mux(stream.encode(av.VideoFrame.from_ndarray(image, format="rgb24")))
        container.mux(stream.encode(None))


def times(clip: str, frames: int | None) -> list[float]:
    """Return times, 0 to 1, of a clip's frames: of all, or of ``frames`` that are spread evenly."""
    count = frames or CLIPS[clip].frames
    return [k / max(1, count - 1) for k in range(count)]


def make_clip(clip: str, options: argparse.Namespace) -> None:
    """Render one clip to ``OUT/CLIP.mp4``, and single frames as PNG if asked."""
    renderer = Renderer(clip, options.spp)
    started, moments = time.time(), times(clip, options.frames)
    images = []
    for k, t in enumerate(moments):
        images.append(encode(renderer.frame(t, k)))
        if options.stills and k % options.stills == 0:
            cv2.imwrite(str(options.out / f"{clip}_{k:04d}.png"), images[-1][..., ::-1])
    path = options.out / f"{clip}.mp4"
    write_video(path, iter(images), options.crf)
    print(f"{path}: {len(moments)} frames, {path.stat().st_size} bytes, {time.time() - started:.1f} s", flush=True)


def make_truth(name: str, options: argparse.Namespace) -> None:
    """Render a scene's first, middle and last frame with its virtual objects as real ones, under ``TRUTH/NAME``."""
    clip = SCENES[name]
    scene = tomllib.loads((HERE / f"{name}.toml").read_text())
    moments = times(clip, options.frames)
    chosen = sorted({0, len(moments) // 2, len(moments) - 1})
    folder = options.truth / name
    objects, lights = scene.get("object", []), scene.get("light", [])
    versions = {"camera": {}}
    versions |= {"object": {"object": objects}} if objects else {}
    versions |= {"light": {"light": lights}} if lights else {}
    versions |= {"both": {"object": objects, "light": lights}} if objects and lights else {}
    for version, virtual in versions.items():
        renderer = Renderer(clip, options.spp, virtual)
        for k in chosen:
            linear = renderer.frame(moments[k], 5000 + k)
            for place, scale in ((version, 1.0),) + ((("dark_50", 0.5),) if version == "camera" else ()):
                (folder / place).mkdir(parents=True, exist_ok=True)
                cv2.imwrite(str(folder / place / f"{k:04d}.png"), encode(linear * scale)[..., ::-1])
    renderer = Renderer(clip, options.spp, with_ball=False)
    (folder / "env").mkdir(exist_ok=True)
    for k in chosen:
        np.save(folder / "env" / f"{k:04d}.npy", renderer.environment(moments[k]).astype(np.float16))
    poses = [
        dict(zip(("R", "t"), (p.tolist() for p in pose(clip, t)), strict=True)) | {"frame": k}
        for k, t in enumerate(moments)
    ]
    levels = [CLIPS[clip].levels(t) for t in moments]
    case = {
        "name": name,
        "clip": clip,
        "frames": len(moments),
        "truth_frames": chosen,
        "dark": [0.5],
        "poses": poses,
        "levels": levels,
    }
    (folder / "case.json").write_text(json.dumps(case, indent=1))
    print(f"{folder}: frames {chosen}", flush=True)


def bundle_truth(name: str, options: argparse.Namespace) -> None:
    """Write the truth of one frame of a scene as a picture that is opaque where it differs from the camera's frame."""
    clip, index = SCENES[name], BUNDLED[name]
    scene = tomllib.loads((HERE / f"{name}.toml").read_text())
    moment, scale = times(clip, None)[index], scene.get("exposure", {}).get("scale", 1.0)
    virtual = {kind: scene.get(kind, []) for kind in ("object", "light")}
    camera = Renderer(clip, options.spp).frame(moment, 5000 + index)
    plain = encode(camera)
    if scale == 1.0:
        truth = encode(Renderer(clip, options.spp, virtual).frame(moment, 5000 + index))
        # As warp_ar.accuracy.metrics.changed_region, but finer and wider: faint shadows and light end softly.
        difference = np.abs(truth.astype(np.float32) - plain).max(-1) / 255
        region, reach = cv2.GaussianBlur(difference, (0, 0), 3.0) > 0.01, 15
    else:
        truth, region, reach = encode(camera * scale), (plain >= 254).any(-1), 5
    alpha = cv2.dilate(region.astype(np.uint8) * 255, np.ones((reach, reach), np.uint8))
    path = HERE / "truth" / f"{name}_{index:04d}.png"
    path.parent.mkdir(exist_ok=True)
    picture = np.where(alpha[..., None] > 0, truth, 0)[..., ::-1]
    cv2.imwrite(str(path), np.concatenate([picture, alpha[..., None]], -1), [cv2.IMWRITE_PNG_COMPRESSION, 9])
    print(f"{path}: {(alpha > 0).mean():.1%} of the picture, {path.stat().st_size} bytes", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--variant", default="cuda_ad_rgb", help="Mitsuba variant: cuda_ad_rgb or llvm_ad_rgb")
    parser.add_argument("--clip", action="append", choices=sorted(CLIPS), help="clip to render (default: all)")
    parser.add_argument(
        "--scene",
        action="append",
        choices=sorted(SCENES),
        help="with --truth or --bundle: scene to render (default: all)",
    )
    parser.add_argument("--frames", type=int, help="render this many frames, spread over the clip's whole motion")
    parser.add_argument("--spp", type=int, default=512, help="samples per pixel (default 512)")
    parser.add_argument("--crf", type=int, default=17, help="quality of H.264, lower is better (default 17)")
    parser.add_argument("--stills", type=int, default=0, help="also write every so many frames as PNG")
    parser.add_argument("--out", type=pathlib.Path, default=HERE / "clips", help="folder of the clips")
    parser.add_argument("--truth", type=pathlib.Path, help="render truth into this folder instead of clips")
    parser.add_argument("--bundle", action="store_true", help="render the truth that is bundled instead of clips")
    options = parser.parse_args()
    mi.set_variant(options.variant)
    if options.bundle:
        for name in options.scene or SCENES:
            bundle_truth(name, options)
        return
    if options.truth:
        for name in options.scene or SCENES:
            make_truth(name, options)
        return
    options.out.mkdir(parents=True, exist_ok=True)
    for clip in options.clip or CLIPS:
        make_clip(clip, options)


if __name__ == "__main__":
    main()
