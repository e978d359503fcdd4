"""Shading of a 640x480 frame: one object that covers a twentieth or a quarter of it, several materials, lights."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import warp as wp

from bench.bench_visibility import Frame, H, W
from bench.common import measure, report
from warp_ar.kernels import structs
from warp_ar.kernels.environment.lobes import lobe_texels
from warp_ar.kernels.objects.reflect import DistantLight, DistantLightConfig
from warp_ar.kernels.objects.shade import ShadeConfig, make_object_light, shade
from warp_ar.kernels.rays.visibility import make_visible
from warp_ar.kernels.split_sum import integrate_dfg

LEVEL_HEIGHT = 64


@dataclasses.dataclass(frozen=True)
class Case:
    """What is shaded, and with what."""

    name: str
    shape: str
    share: float
    model: int
    lights: tuple[int, ...]
    edge_samples: int


CASES = (
    Case("chalk", "sphere", 0.05, structs.LAMBERT, (), 4),
    Case("gold, hard edges", "mesh", 0.05, structs.METALLIC_ROUGHNESS, (), 1),
    Case("gold", "mesh", 0.05, structs.METALLIC_ROUGHNESS, (), 4),
    Case("gold under a spot light", "mesh", 0.05, structs.METALLIC_ROUGHNESS, (structs.SPOT,), 4),
    Case("gold under a spot light", "mesh", 0.25, structs.METALLIC_ROUGHNESS, (structs.SPOT,), 4),
)


def main(device: str) -> None:
    sh = np.zeros((9, 3), np.float32)
    sh[0] = math.pi / 0.28209479
    dfg = wp.zeros((32, 32), dtype=wp.vec2, device=device)
    integrate_dfg(dfg)
    surroundings = DistantLight()
    surroundings.irradiance_sh = wp.array(sh, dtype=wp.vec3, device=device)
    surroundings.levels = wp.full(lobe_texels(LEVEL_HEIGHT), wp.vec3(1.0), dtype=wp.vec3, device=device)
    surroundings.level_height, surroundings.dfg = LEVEL_HEIGHT, dfg
    for case in CASES:
        frame = Frame(case.shape, case.share, device)
        material = np.zeros(1, np.dtype(structs.Material.numpy_dtype()))
        material["model"], material["base_color"], material["metallic"], material["roughness"] = (
            case.model,
            1.0,
            1.0,
            0.3,
        )
        material["base_texture"] = material["specular_texture"] = -1
        frame.scene.materials = wp.array(material, dtype=structs.Material, device=device)
        light = np.zeros(len(case.lights), np.dtype(structs.Light.numpy_dtype()))
        light["kind"], light["direction"], light["attenuation"] = structs.SPOT, (0, 0.6, 0.8), (0, 0, 1)
        light["position"], light["inner_angle"], light["outer_angle"] = (0, -0.6, 0.2), 0.4, 0.6
        glossy = case.model != structs.LAMBERT
        forms = DistantLightConfig(
            trace=frame.config,
            models=(case.model,),
            textures=False,
            diffuse="none" if glossy else "sh",
            specular=glossy,
            probes=False,
        )
        config = ShadeConfig(forms, case.lights, case.edge_samples)
        light_array = wp.array(light, dtype=structs.Light, device=device)
        virtual = wp.zeros((H, W), dtype=wp.vec4, device=device)
        inputs = (frame.params, frame.rays, frame.scene, make_object_light(surroundings, light_array))

        def call(config=config, inputs=inputs, frame=frame, virtual=virtual):
            shade(config, *inputs, make_visible(frame.found, frame.hits), virtual, rows=frame.launch_rows)

        frame.trace()
        call()
        if not case.lights:  # a white furnace: radiance equals coverage
            image = virtual.numpy()
            np.testing.assert_allclose(image[..., 0], image[..., 3], atol=1e-4)
        label = f"shade {W}x{H} {case.name}, {case.share:.0%}, {case.edge_samples} edge samples"
        report(label, measure({"ours": call}, device)["ours"], device)
