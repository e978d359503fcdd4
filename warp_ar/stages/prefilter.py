"""The environment as glossy materials reflect it, from mirror to matt."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar

import numpy as np
import warp as wp

from warp_ar.kernels import prefilter, pyramid
from warp_ar.scene import Material, MirrorMaterial, PhongMaterial, Scene
from warp_ar.scene.ray_scene import reflects_glossily
from warp_ar.stages.base import Arrays, ArraySpec, LeftOut, Pass, Request, Stage, Wiring
from warp_ar.stages.environment_shadow import bounces_light


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
    methods: ClassVar[tuple[str, ...]] = ("box_mip", "energy_mip", "fis32", "fis128", "brute_force")
    summary: ClassVar[str] = "the environment filtered for glossy reflection, level by level"

    @classmethod
    def wire(cls, request: Request) -> Wiring | LeftOut:
        """Read the environment, write the levels."""
        if not request.scene.objects:
            return LeftOut("the scene has no virtual object")
        if not request.scene.probes:
            return LeftOut("the scene has no probe, so the environment is unknown")
        if not glossy_materials(request.scene):
            return LeftOut("no virtual object has a glossy material")
        return Wiring(("environment",), ("prefilter_levels",))

    @property
    def _mirrors_only(self) -> bool:
        mirrors = all(isinstance(material, MirrorMaterial) for material in glossy_materials(self.request.scene))
        return mirrors and not bounces_light(self.request)

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
