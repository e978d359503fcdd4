"""The environment as glossy materials reflect it, from mirror to matt."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar

import numpy as np
import warp as wp

from warp_ar.kernels import prefilter, pyramid
from warp_ar.scene import Material, MirrorMaterial, PhongMaterial, Scene
from warp_ar.scene.ray_scene import reflects_glossily
from warp_ar.stages.base import Arrays, ArraySpec, LeftOut, Numerics, Pass, Stage, Wiring
from warp_ar.stages.features import NO_BALL, Features


def glossy_materials(scene: Scene) -> list[Material]:
    """Materials of virtual objects that reflect more than diffusely."""
    return [item.material for item in scene.objects if reflects_glossily(item.material)]


def scene_lobe(scene: Scene) -> prefilter.Lobe:
    """Phong where no glossy material has another lobe, else GGX: exponents then take the width that is nearest."""
    kinds = {type(material) for material in glossy_materials(scene)} - {MirrorMaterial}
    return "phong" if kinds == {PhongMaterial} else "ggx"


class Prefilter(Stage):
    """Prefilters the environment with lobes of growing width."""

    name: ClassVar[str] = "prefilter"
    methods: ClassVar[Mapping[str, str]] = {
        "box_mip": "a pyramid of means (the paper)",
        "energy_mip": "a pyramid that keeps energy, mixed to fit the lobe",
        "fis32": "32 importance samples per texel",
        "fis128": "128 importance samples per texel",
        "brute_force": "every texel for every direction and width",
    }
    summary: ClassVar[str] = "the environment filtered for glossy reflection, level by level"
    subject: ClassVar[str] = "light that glossy surfaces reflect"
    unread: ClassVar[str] = "no virtual object has a glossy material"
    converges: ClassVar[bool] = True
    settings: ClassVar[tuple[str, ...]] = ("environment_height",)
    unseen_method: ClassVar[str | None] = "box_mip"
    numerics: ClassVar[Numerics] = Numerics(
        precision="float32; versines, weights made in float64",
        bound=5e-5,
        cause="sums over the map, powers with exponents up to 1e3",
        measured=4.7e-07,
        rows=(4, 5, 6, 8, 17, 18),
    )

    @classmethod
    def wire(cls, features: Features) -> Wiring | LeftOut:
        """Read the environment, write the levels."""
        return Wiring(("environment",), ("prefilter_levels",)) if features.environment else LeftOut(NO_BALL)

    @property
    def _mirrors_only(self) -> bool:
        mirrors = all(isinstance(material, MirrorMaterial) for material in glossy_materials(self.request.scene))
        # Light that objects reflect onto the receiver is read as a wide lobe of every material.
        return mirrors and not self.features.shadowed

    def arrays(self) -> Mapping[str, ArraySpec]:
        """Levels, and the pyramid that the levels are made from."""
        height = self.request.quality.environment_height
        specs = {"prefilter_levels": ArraySpec((prefilter.lobe_texels(height),), wp.vec3)}
        if self.method != "brute_force" and not self._mirrors_only:
            specs["prefilter_pyramid"] = ArraySpec((pyramid.packed_texels(height, 2 * height),), wp.vec3)
            specs["prefilter_blocks_done"] = ArraySpec((1,), wp.int32)
        if self.method not in ("box_mip", "brute_force") and not self._mirrors_only:
            specs["prefilter_row_energy"] = ArraySpec((prefilter.lobe_rows(height),), wp.vec3)
            specs["prefilter_energy"] = ArraySpec((prefilter.lobe_count(height),), wp.vec3)
        return specs

    def build(self, arrays: Arrays, device: Any) -> list[Pass]:
        """Launches of the method; weights and samples are made here, once."""
        height = self.request.quality.environment_height
        lobe = scene_lobe(self.request.scene)
        environment, levels = arrays["environment"], arrays["prefilter_levels"]
        if self._mirrors_only:
            return [Pass(lambda rows: pyramid.copy_safe(environment, levels, rows=rows), rows=height)]
        texels = levels.shape[0]
        if self.method == "brute_force":
            return [Pass(lambda rows: prefilter.integrate_lobes(environment, lobe, levels, rows=rows), rows=texels)]

        box, blocks_done = arrays["prefilter_pyramid"], arrays["prefilter_blocks_done"]
        isotropic = self.method != "box_mip"
        passes = [Pass(lambda rows: pyramid.build_pyramid(environment, blocks_done, box, isotropic=isotropic))]
        if self.method in ("box_mip", "energy_mip"):
            numbers = prefilter.mip_weights(height, lobe) if isotropic else prefilter.box_weights(height)
            weights = wp.array(numbers.astype(np.float32), dtype=wp.float32, device=device)
            passes.append(
                Pass(
                    lambda rows: prefilter.mix_mips(box, weights, height, levels, smooth=isotropic, rows=rows),
                    rows=prefilter.mixed_texels(height),
                )
            )
        else:
            samples = prefilter.make_lobe_samples(height, lobe, int(self.method.removeprefix("fis")), device)
            passes.append(
                Pass(lambda rows: prefilter.sample_lobes(box, samples, height, levels, rows=rows), rows=texels)
            )
        if isotropic:
            row_energy, energy = arrays["prefilter_row_energy"], arrays["prefilter_energy"]
            passes += [
                Pass(lambda rows: prefilter.measure_energy(levels, height, row_energy, energy)),
                Pass(lambda rows: prefilter.scale_levels(energy, height, levels, rows=rows), rows=texels),
            ]
        return passes
