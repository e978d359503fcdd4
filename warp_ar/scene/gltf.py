"""Reader of glTF 2.0 and GLB: nodes, meshes, primitives, materials, pictures and animations.

trimesh is not used, because it drops samplers, texture transforms, the second set of texture coordinates, vertex
colours of textured meshes, and the strength of emission.

References:
    Khronos, glTF 2.0 specification; sections 3.8 and 3.9 (materials), appendix A (skins and morph targets).
    KHR_texture_transform, KHR_materials_emissive_strength, KHR_materials_unlit, EXT_texture_webp.
"""

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Callable, Iterator, Mapping
from typing import Any, Final, TypeAlias

import numpy as np
import numpy.typing as npt

from warp_ar.errors import SceneError
from warp_ar.files import limits, too_much
from warp_ar.pictures import in_srgb, picture_size
from warp_ar.scene.geometry import creased_normals, unit_or
from warp_ar.scene.gltf_file import GltfFile
from warp_ar.scene.materials import IDENTITY, MeshMaterial, MetallicRoughnessMaterial, TextureUse, Wrap
from warp_ar.scene.mesh_parts import LARGEST, MeshPart, strip_triangles
from warp_ar.scene.mesh_source import MeshSource
from warp_ar.scene.node_animation import INTERPOLATIONS, WIDTHS, Anchor, NodeTrack, Sampler, part_transforms
from warp_ar.scene.polygon_files import CREASE, linear_rgba
from warp_ar.scene.textures import decode_rgba

SUPPORTED: Final = (
    "KHR_materials_emissive_strength",
    "KHR_materials_unlit",
    "KHR_mesh_quantization",
    "KHR_texture_transform",
    "EXT_texture_webp",
)
"""Supported extensions."""

_WRAPS: Final[dict[int, Wrap]] = {10497: "repeat", 33071: "clamp", 33648: "mirror"}
_NEAREST: Final = 9728
_BRIGHTEST: Final = 1e6
"""Largest emitted radiance of a material; larger values would cost the exposure's and the encoding's precision."""


class GltfMaterials:
    """Reader of the materials of one file; each is read once."""

    def __init__(self, file: GltfFile, take_image: Callable[[int], int]) -> None:
        """Store the file; read no material yet.

        Args:
            file: The file.
            take_image: Function from an image index of the file to its index in ``Mesh.images``.
        """
        self._file, self._take_image = file, take_image
        self._materials, self._textures, self._samplers, self._images = (
            file.objects(key) for key in ("materials", "textures", "samplers", "images")
        )
        self._known: dict[int, MeshMaterial] = {}

    def read(self, index: object) -> MeshMaterial:
        """Return the material with an index of the file; None gives glTF's default material.

        Raises:
            SceneError: The material or one of its textures does not exist, or a factor is no number.
        """
        if index is None:
            return self._material({}, "")
        number = self._file.index(index, len(self._materials), "a mesh names material")
        if number not in self._known:
            item = self._materials[number]
            self._known[number] = self._material(item, str(item.get("name", ""))[:80])
        return self._known[number]

    def _material(self, item: dict[str, Any], name: str) -> MeshMaterial:
        file, label = self._file, f"material {name!r}" if name else "a material"
        reflection = file.table(item, "pbrMetallicRoughness", label)
        extensions = file.table(item, "extensions", label)
        color = file.numbers(reflection, "baseColorFactor", (1.0, 1.0, 1.0, 1.0), 1.0, label)
        metallic = file.number(reflection, "metallicFactor", 1.0, 1.0, label)
        roughness = file.number(reflection, "roughnessFactor", 1.0, 1.0, label)
        normal, occlusion = (file.table(item, key, label) for key in ("normalTexture", "occlusionTexture"))
        strength = file.table(extensions, "KHR_materials_emissive_strength", label)
        glow = file.number(strength, "emissiveStrength", 1.0, _BRIGHTEST, label)
        red, green, blue = file.numbers(item, "emissiveFactor", (0.0, 0.0, 0.0), 1.0, label)
        emission = glow * red, glow * green, glow * blue
        mode = item.get("alphaMode", "OPAQUE")
        if mode not in ("OPAQUE", "MASK", "BLEND"):
            file.fail(f"{label} has alphaMode {str(mode)[:20]!r}; OPAQUE, MASK or BLEND are right")
        return MeshMaterial(
            surface=MetallicRoughnessMaterial(color[:3], metallic, roughness),  # type: ignore[arg-type]
            name=name,
            alpha=mode.lower(),
            opacity=color[3],
            cutoff=file.number(item, "alphaCutoff", 0.5, 1e6, label),
            double_sided=item.get("doubleSided") is True,
            unlit="KHR_materials_unlit" in extensions,
            emission=emission,
            base=self._use(reflection, "baseColorTexture", label),
            metallic_roughness=self._use(reflection, "metallicRoughnessTexture", label),
            normal=self._use(item, "normalTexture", label),
            normal_scale=file.number(normal, "scale", 1.0, 1e3, label, low=-1e3),
            occlusion=self._use(item, "occlusionTexture", label),
            occlusion_strength=file.number(occlusion, "strength", 1.0, 1.0, label),
            emissive=self._use(item, "emissiveTexture", label) if any(emission) else None,
        )

    def _use(self, item: dict[str, Any], key: str, label: str) -> TextureUse | None:
        file = self._file
        reference = file.table(item, key, label)
        if not reference:
            return None
        index = file.index(reference.get("index"), len(self._textures), f"{label} names texture")
        texture, label = self._textures[index], f"texture {index}"
        webp = file.table(file.table(texture, "extensions", label), "EXT_texture_webp", label)
        source = webp.get("source", texture.get("source"))
        if source is None:
            file.source.note("a texture in a format of an extension")
            return None
        transform = file.table(file.table(reference, "extensions", label), "KHR_texture_transform", label)
        uv_set = transform.get("texCoord", reference.get("texCoord", 0))
        if uv_set not in (0, 1):
            file.source.note("texture coordinates beyond the second set")
            return None
        settings: dict[str, Any] = {}
        if (sampler := texture.get("sampler")) is not None:
            settings = self._samplers[file.index(sampler, len(self._samplers), f"{label} names sampler")]
        wraps = [settings.get(name, 10497) for name in ("wrapS", "wrapT")]
        if any(not isinstance(wrap, int) or wrap not in _WRAPS for wrap in wraps):
            file.fail(f"{label} wraps as {str(wraps)[:30]}; {', '.join(map(str, _WRAPS))} are right")
        return TextureUse(
            image=self._take_image(file.index(source, len(self._images), f"{label} names image")),
            uv_set=int(uv_set),
            transform=self._transform(transform, label),
            wrap=(_WRAPS[wraps[0]], _WRAPS[wraps[1]]),
            nearest=settings.get("magFilter") == _NEAREST,
        )

    def _transform(self, item: dict[str, Any], label: str) -> tuple[float, ...]:
        """Return the rows of KHR_texture_transform for texture coordinates whose v points up.

        glTF's v points down, and (u', v') = T R S (u, v). With w = 1 - v, the rows give u' and 1 - v'.
        """
        if not item:
            return IDENTITY
        x, y = self._file.numbers(item, "offset", (0.0, 0.0), 1e6, label, low=-1e6)
        width, height = self._file.numbers(item, "scale", (1.0, 1.0), 1e6, label, low=-1e6)
        angle = self._file.number(item, "rotation", 0.0, 1e6, label, low=-1e6)
        cos, sin = math.cos(angle), math.sin(angle)
        a, b = cos * width, sin * height
        d, e = -sin * width, cos * height
        return (a, -b, b + x, -d, e, 1.0 - e - y)


_WEIGHTS: Final = "weights"
"""Target path of channels that animate morph weights."""
_SHORTEST: Final = 1e-12
"""Length below which a quaternion has no direction."""


@dataclasses.dataclass(frozen=True, eq=False)
class GltfAnimation:
    """One animation of a file."""

    samplers: Mapping[int, Mapping[str, Sampler]]
    """Samplers by node index, then by animated property."""
    weights: Mapping[int, Sampler]
    """Samplers of morph weights, by the index of the mesh's node."""
    duration: float
    """Time of the last key, in seconds."""


def animation_names(file: GltfFile) -> list[str]:
    """Return the names of a file's animations in file order; an unnamed animation has an empty name.

    Raises:
        SceneError: The file's ``animations`` is no list of objects.
    """
    return [str(item.get("name", ""))[:60] for item in file.objects("animations")]


def read_animation(file: GltfFile, wanted: str | int) -> GltfAnimation:
    """Read one animation.

    Args:
        file: The file.
        wanted: Name of the animation, or its number from 0 on.

    Raises:
        SceneError: There is no such animation, or it is damaged.
    """
    number = _find(file, wanted)
    item, label = file.objects("animations")[number], f"animation {number}"
    known: dict[tuple[int, str], Sampler] = {}
    found: dict[int, dict[str, Sampler]] = {}
    samplers, count = file.objects("samplers", item), len(file.objects("nodes"))
    for channel in file.objects("channels", item):
        target = channel.get("target")
        if not isinstance(target, dict):
            file.fail(f"{label} has a channel without a target")
        prop = target.get("path")
        if not isinstance(prop, str) or prop not in (*WIDTHS, _WEIGHTS):
            file.source.note(f"animated {str(prop)[:30]}")
            continue
        if target.get("node") is None:  # an extension may name the target instead
            continue
        node = file.index(target["node"], count, f"{label} moves node")
        index = file.index(channel.get("sampler"), len(samplers), f"{label} has a channel of sampler")
        if prop in found.setdefault(node, {}):
            file.fail(f"{label} moves the {prop} of node {node} twice")
        if (index, prop) not in known:
            known[index, prop] = _read_sampler(file, samplers[index], prop, f"{label}, sampler {index}")
        found[node][prop] = known[index, prop]
    duration = max((float(sampler.times[-1]) for sampler in known.values()), default=0.0)
    weights = {node: moved.pop(_WEIGHTS) for node, moved in found.items() if _WEIGHTS in moved}
    return GltfAnimation({node: moved for node, moved in found.items() if moved}, weights, duration)


def _find(file: GltfFile, wanted: str | int) -> int:
    names = animation_names(file)
    if not names:
        file.fail("it has no animation; leave out the object's animation")
    if isinstance(wanted, int):
        return file.index(wanted, len(names), "asked for is animation")
    if wanted not in names:
        known = ", ".join(repr(name) for name in names[:8]) + (", ..." if len(names) > 8 else "")
        file.fail(f"animation {wanted!r} is asked for; it has {known}")
    return names.index(wanted)


def _read_sampler(file: GltfFile, item: dict[str, Any], prop: str, label: str) -> Sampler:
    way, width = item.get("interpolation", "LINEAR"), WIDTHS.get(prop, 1)
    if way not in INTERPOLATIONS:
        file.fail(f"{label} has the interpolation {str(way)[:20]!r}; {', '.join(INTERPOLATIONS)} are right")
    times = np.asarray(file.array(item.get("input"), f"{label}: input", 1), dtype=np.float64)[:, 0]
    values = np.asarray(file.array(item.get("output"), f"{label}: output", width), dtype=np.float64)
    count, each = len(times), 3 if way == "CUBICSPLINE" else 1
    if prop == _WEIGHTS and count and len(values) and not len(values) % (each * count):
        width = len(values) // (each * count)
        values = values.reshape(-1, width)
    if not count:
        file.fail(f"{label} has no keyframe")
    if not (np.abs(times) < LARGEST).all() or (np.diff(times) < 0.0).any() or times[0] < 0.0:
        file.fail(f"{label} has times that are not finite, below 0, or not in order")
    if len(values) != each * count:
        file.fail(f"{label} has {count} times and {len(values)} values; {each * count} are right")
    if not (np.abs(values) < LARGEST).all():
        file.fail(f"{label} has a value that is not finite, or above {LARGEST:g}")
    shaped: npt.NDArray[np.float64] = values.reshape(count, 3, width) if each == 3 else values
    keys = shaped[:, 1] if each == 3 else shaped
    if prop == "rotation" and not (np.linalg.norm(keys, axis=1) > _SHORTEST).all():
        file.fail(f"{label} has a rotation without length")
    return Sampler(times, shaped, way, prop == "rotation")


Array = npt.NDArray[np.float64]

_TRIANGLES, _STRIP, _FAN = 4, 5, 6
_UP: Final = np.array([[1.0, 0.0, 0.0, 0.0], [0.0, 0.0, -1.0, 0.0], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]])
"""Transform from +Y up to +Z up, (4, 4)."""
_SAME_COLOR: Final = 2
"""Largest change of 8-bit codes by an ICC profile that counts as sRGB itself."""
_MOST_IMAGES: Final = 4
"""Most pixels of all pictures of a file together, as a multiple of the limit for one picture."""
_MOST_PLACES: Final = 20_000
"""Most nodes of a file, and most placed primitives."""
_COMPRESSED: Final = ("KHR_draco_mesh_compression", "EXT_meshopt_compression", "KHR_meshopt_compression")


Bending: TypeAlias = Callable[[float], MeshPart | None]
"""Function from the animation's time in seconds to a deformed part with the same faces, or None."""
_Bones: TypeAlias = Callable[[float], Array]
"""Function from the animation's time in seconds to the transform of each vertex, (n, 4, 4), including +Z up."""


@dataclasses.dataclass
class GltfContents:
    """Contents of a glTF file in its world, rotated to +Z up."""

    placed: list[tuple[int, MeshPart, Bending | None]]
    """Primitives, one entry for each place: index of the anchor in whose coordinates the triangles are (-1: the world),
    the triangles, and their deformation by skins or morph targets (None: rigid)."""
    anchors: tuple[Anchor, ...] = ()
    """Animated nodes."""
    duration: float = 0.0
    """Duration of the animation, seconds."""

    @property
    def parts(self) -> list[MeshPart]:
        """Return the triangles of all primitives."""
        return [part for _, part, _ in self.placed]


def load_gltf(source: MeshSource, *, animation: str | int | None = None, memory: bool = False) -> GltfContents:
    """Read the triangles of a file's scene, with materials.

    Follows:
        nodes and their animations; triangles, strips, fans; sparse accessors; core materials, samplers; tangents,
        COLOR_0, TEXCOORD_0 and 1; skins and morph targets; KHR_texture_transform, KHR_materials_unlit,
        KHR_materials_emissive_strength, KHR_mesh_quantization, EXT_texture_webp.

    Names:
        other extensions; factors beyond their ranges.

    Args:
        source: The file.
        animation: Name or index of the animation to play; None: the nodes keep the file's static transforms.
        memory: True if trimesh exported the file from a mesh in memory: axes are not rotated, vertex colours are
            sRGB-encoded, and without normals, edges that turn by more than ``CREASE`` degrees are sharp.

    Raises:
        SceneError: Damaged; meshes compressed by Draco or meshopt.
    """
    return _Reader(source, memory=memory).contents(animation)


@dataclasses.dataclass(frozen=True)
class _Place:
    """Transforms of a node."""

    world: Array
    """Transform to the file's world at time 0, (4, 4)."""
    below: Array
    """Transform to the coordinates of its anchor, or without anchor to the world rotated to +Z up, (4, 4)."""
    carrier: int = -1
    """Index of the nearest animated node at or above it; -1: none."""


class _Reader:
    """Reader of one file's scene graph."""

    def __init__(self, source: MeshSource, *, memory: bool) -> None:
        self._source, self._file, self._memory = source, GltfFile(source), memory
        self._up = np.eye(4) if memory else _UP
        self._materials = GltfMaterials(self._file, self._take_image)
        self._nodes, self._meshes, self._skins = (self._file.objects(key) for key in ("nodes", "meshes", "skins"))
        self._primitives: dict[tuple[int, int], MeshPart | None] = {}
        self._images: dict[int, int] = {}
        self._pixels = self._elements = 0
        self._anchors: list[Anchor] = []
        self._places: dict[int, _Place] = {}

    def contents(self, animation: str | int | None) -> GltfContents:
        """Return all contents of the scene."""
        self._look_at_extensions()
        if animation is None and animation_names(self._file):
            self._source.note("animations (an object's key play names one)")
        if self._file.objects("cameras"):
            self._source.note("cameras")
        if len(self._nodes) > _MOST_PLACES:
            self._file.fail(f"it has {len(self._nodes):,} nodes; at most {_MOST_PLACES:,} are read: join them")
        still = GltfAnimation({}, {}, 0.0)
        moves = still if animation is None else read_animation(self._file, animation)
        self._place_nodes(moves)
        shown = [self._nodes[index] for index in self._places]
        meshes = self._file.indices(
            [node["mesh"] for node in shown if "mesh" in node], len(self._meshes), "a node's mesh is"
        )
        count = sum(len(self._file.objects("primitives", self._meshes[number])) for number in meshes)
        if count > _MOST_PLACES:
            self._file.fail(f"its nodes place {count:,} primitives; at most {_MOST_PLACES:,} are read: join them")
        placed = []
        for node, (index, place) in zip(shown, self._places.items(), strict=True):
            if "mesh" in node:
                # The joints alone place a skinned mesh; its own node's transform is ignored.
                place = place if "skin" not in node else _Place(place.world, self._up @ place.world)
                found = self._mesh(node, place.below, moves.weights.get(index))
                placed += [(place.carrier, part, bend) for part, bend in found]
        return GltfContents(placed, tuple(self._anchors), moves.duration)

    def _look_at_extensions(self) -> None:
        used, required = (self._file.header.get(key, []) for key in ("extensionsUsed", "extensionsRequired"))
        if not isinstance(used, list) or not isinstance(required, list):
            self._file.fail("extensionsUsed or extensionsRequired is no list")
        for name in required:
            if name in _COMPRESSED:
                self._file.fail(f"it is compressed with {name}; save it without compression")
        # A file should list all extensions that it uses; others are noted as well.
        kinds = ("materials", "textures", "nodes")
        own = [item.get("extensions") for kind in kinds for item in self._file.objects(kind)]
        found = [name for table in own if isinstance(table, dict) for name in table]
        for name in dict.fromkeys(str(name)[:60] for name in [*used, *required, *found]):
            if name not in SUPPORTED:
                self._source.note(name)

    # ---- nodes ---------------------------------------------------------------------------------------------------

    def _place_nodes(self, moves: GltfAnimation) -> None:
        """Compute the transforms of all nodes of the scene, and the animated nodes above them."""
        scenes, count = self._file.objects("scenes"), len(self._nodes)
        below = [
            self._file.indices(node.get("children"), count, f"a child of node {index} is")
            for index, node in enumerate(self._nodes)
        ]
        if scenes:
            number = self._file.index(self._file.header.get("scene", 0), len(scenes), "the scene is")
            roots = self._file.indices(scenes[number].get("nodes"), count, "the scene has node")
        else:
            roots = sorted(set(range(count)) - {child for children in below for child in children})
            if self._nodes and not roots:
                self._file.fail("its nodes stand below each other in a circle")
        waiting = [(node, _Place(np.eye(4), self._up)) for node in reversed(roots)]
        while waiting:
            index, above = waiting.pop()
            if index in self._places:
                self._file.fail(f"node {index} is reached twice: nodes form no tree")
            local = self._local(self._nodes[index], index)
            with np.errstate(invalid="ignore", over="ignore"):
                world = above.world @ local
            if not (np.abs(world) < LARGEST).all():
                self._file.fail(f"node {index} has a transform that is not finite, or above {LARGEST:g}")
            if (samplers := moves.samplers.get(index)) is None:
                place = _Place(world, above.below @ local, above.carrier)
            else:
                if "matrix" in self._nodes[index]:
                    right = "translation, rotation and scale are right"
                    self._file.fail(f"an animation moves node {index}, which has a matrix; {right}")
                track = dataclasses.replace(self._track(self._nodes[index], index), samplers=samplers)
                place = _Place(world, np.eye(4), len(self._anchors))
                self._anchors.append(Anchor(above.carrier, above.below, track))
            self._places[index] = place
            waiting += [(child, place) for child in reversed(below[index])]

    def _numbers(self, node: dict[str, Any], index: int, key: str, *default: float) -> Array:
        return np.array(self._file.numbers(node, key, default, LARGEST, f"node {index}", low=-LARGEST))

    def _local(self, node: dict[str, Any], index: int) -> Array:
        if "matrix" in node:
            return self._numbers(node, index, "matrix", *[0.0] * 16).reshape(4, 4).T
        with np.errstate(invalid="ignore", over="ignore"):  # the caller checks that it is finite
            return self._track(node, index).transform_at(0.0)

    def _track(self, node: dict[str, Any], index: int) -> NodeTrack:
        """Return the track of a node's translation, rotation and scale."""
        rotation = self._numbers(node, index, "rotation", 0.0, 0.0, 0.0, 1.0)
        length = float(np.sqrt((rotation * rotation).sum()))
        if not 0.0 < length < np.inf:
            self._file.fail(f"node {index} has a rotation without length")
        scale = self._numbers(node, index, "scale", 1.0, 1.0, 1.0)
        return NodeTrack(self._numbers(node, index, "translation", 0.0, 0.0, 0.0), rotation / length, scale, {})

    # ---- meshes --------------------------------------------------------------------------------------------------

    def _mesh(
        self, node: dict[str, Any], transform: Array, weights: Sampler | None
    ) -> Iterator[tuple[MeshPart, Bending | None]]:
        """Yield a node's primitives at time 0, placed by ``transform`` or joints, each with its deformation."""
        number = node["mesh"]
        for primitive in self._file.objects("primitives", self._meshes[number]):
            if primitive.get("mode", _TRIANGLES) not in (_TRIANGLES, _STRIP, _FAN):
                self._source.note("points and lines")
                continue
            # Thousands of nodes may share the same triangles.
            key = (number, id(primitive))
            if key not in self._primitives:
                self._primitives[key] = self._primitive(primitive)
            if (part := self._primitives[key]) is None:
                continue
            self._elements += len(part.faces)
            self._source.check_count(self._elements)
            bones, moves = self._bones(node, primitive) if "skin" in node else (None, False)
            shown = weights or self._still_weights(node)
            morph = None if shown is None else self._morph(primitive, part, shown)
            bend = functools.partial(_bend, part, morph, bones, transform)
            if (placed := bend(0.0)) is not None:
                yield placed, bend if moves or (weights and morph) else None

    def _primitive(self, primitive: dict[str, Any]) -> MeshPart | None:
        attributes = self._file.table(primitive, "attributes", "a primitive")
        if "POSITION" not in attributes:
            self._source.note("primitives without positions")
            return None
        vertices = np.asarray(self._file.array(attributes["POSITION"], "POSITION", 3), dtype=np.float64)
        count = len(vertices)

        def attribute(name: str, *widths: int) -> Array | None:
            if name not in attributes:
                return None
            values = self._file.array(attributes[name], name, *widths)
            if len(values) != count:
                self._file.fail(f"{name} has {len(values)} elements, POSITION {count}")
            return np.asarray(values, dtype=np.float64)

        colors = attribute("COLOR_0", 3, 4)
        if colors is not None and colors.shape[1] == 3:
            colors = np.concatenate([colors, np.ones((count, 1))], axis=1)
        if "COLOR_1" in attributes:
            self._source.note("colours beyond the first set")
        if colors is not None and self._memory:
            colors = linear_rgba(colors, 1.0)
        faces = self._faces(primitive, count)
        self._source.check_count(len(faces))
        if not len(faces):
            return None
        number = primitive.get("material")
        material = None if self._memory and number is None else self._materials.read(number)
        return MeshPart.checked(
            f"{self._source.path}",
            vertices,
            faces,
            attribute("NORMAL", 3),
            uvs=(_upward(attribute("TEXCOORD_0", 2)), _upward(attribute("TEXCOORD_1", 2))),
            colors=None if colors is None else np.clip(colors, 0.0, 1.0),
            tangents=attribute("TANGENT", 4),
            material=material,
            crease=CREASE
            if self._memory
            else 0.0,  # "When normals are not specified, client implementations MUST calculate flat normals"
        )

    def _faces(self, primitive: dict[str, Any], count: int) -> npt.NDArray[np.int64]:
        if "indices" in primitive:
            indices = self._file.array(primitive["indices"], "indices", 1)[:, 0]
            if indices.dtype.kind != "u":
                self._file.fail("indices are no whole numbers without sign")
            indices = np.asarray(indices, dtype=np.int64)
        else:
            indices = np.arange(count, dtype=np.int64)
        mode = primitive.get("mode", _TRIANGLES)
        if mode == _TRIANGLES:
            return indices[: len(indices) // 3 * 3].reshape(-1, 3)
        if len(indices) < 3:
            return np.zeros((0, 3), np.int64)
        if mode == _STRIP:
            return strip_triangles(indices)
        return np.stack([np.full(len(indices) - 2, indices[0]), indices[1:-1], indices[2:]], axis=-1)

    def _still_weights(self, node: dict[str, Any]) -> Sampler | None:
        """Return the weights of a node's morph targets without animation; None if they displace nothing."""
        weights = node.get("weights", self._meshes[node["mesh"]].get("weights"))
        if not isinstance(weights, list):
            return None
        label = "a morph target"
        found = [self._file.number({"weight": one}, "weight", 0.0, LARGEST, label, low=-LARGEST) for one in weights]
        return Sampler(np.zeros(1), np.array([found]), "STEP") if any(found) else None

    def _delta(self, target: dict[str, Any], name: str, count: int) -> Array:
        """Return the displacement of an attribute by a morph target, (count, 3); zeros if the target has none."""
        if name not in target:
            return np.zeros((count, 3))
        delta = self._file.array(target[name], f"{name} of a morph target", 3)
        if len(delta) != count:
            self._file.fail(f"{name} of a morph target has {len(delta)} elements, not {count}")
        return np.asarray(delta, dtype=np.float64)

    def _morph(self, primitive: dict[str, Any], part: MeshPart, weights: Sampler) -> Bending | None:
        """Return a function from a time to the part displaced by its morph targets; None if it has none."""
        targets, attributes = self._file.objects("targets", primitive), primitive["attributes"]
        targets = targets[: weights.at(0.0).size]
        if not targets:
            return None
        vertices = np.asarray(self._file.array(attributes["POSITION"], "POSITION", 3), dtype=np.float64)
        normals = self._file.array(attributes["NORMAL"], "NORMAL", 3) if "NORMAL" in attributes else None
        count, names = len(vertices), ("POSITION", "NORMAL")
        deltas, turns = (np.stack([self._delta(target, name, count) for target in targets]) for name in names)
        where = np.arange(count) if part.source is None else part.source

        def morph(seconds: float) -> MeshPart:
            weight = weights.at(seconds)[: len(targets)]
            placed = (vertices + np.tensordot(weight, deltas, 1))[where]
            if normals is None:  # no vertex is shared between triangles
                turned = creased_normals(placed, part.faces, 0.0)[1].astype(np.float64)
            else:
                turned = unit_or((normals + np.tensordot(weight, turns, 1))[where], part.normals)
            return dataclasses.replace(part, vertices=placed, normals=turned)

        return morph

    def _bones(self, node: dict[str, Any], primitive: dict[str, Any]) -> tuple[_Bones | None, bool]:
        """Return the transforms of the vertices by the joints, and True if the joints move; None without a skin."""
        number = self._file.index(node["skin"], len(self._skins), "a node's skin is")
        skin, attributes = self._skins[number], primitive["attributes"]
        joints = self._file.indices(skin.get("joints"), len(self._nodes), "a joint of a skin is node")
        if not joints or "JOINTS_0" not in attributes or "WEIGHTS_0" not in attributes:
            return None, False
        if "JOINTS_1" in attributes:
            self._source.note("joints beyond four per vertex")
        inverse = np.tile(np.eye(4), (len(joints), 1, 1))
        if "inverseBindMatrices" in skin:
            values = self._file.array(skin["inverseBindMatrices"], "inverseBindMatrices", 16)
            if len(values) < len(joints):
                self._file.fail(f"a skin has {len(joints)} joints and {len(values)} inverse bind matrices")
            inverse = values[: len(joints)].reshape(-1, 4, 4).transpose(0, 2, 1)
        count = len(self._file.array(attributes["POSITION"], "POSITION", 3))
        places = self._file.array(attributes["JOINTS_0"], "JOINTS_0", 4)
        weights = np.asarray(self._file.array(attributes["WEIGHTS_0"], "WEIGHTS_0", 4), dtype=np.float64)
        if len(places) != count or len(weights) != count or places.dtype.kind != "u":
            self._file.fail(f"JOINTS_0 and WEIGHTS_0 are not of {count} vertices")
        if count and int(places.max()) >= len(joints):
            self._file.fail(f"JOINTS_0 holds {int(places.max())}; the skin has {len(joints)} joints, from 0 on")
        standing = [self._places.get(joint, _Place(np.eye(4), self._up)) for joint in joints]
        bones = np.stack([place.below for place in standing]) @ inverse
        total = weights.sum(axis=1, keepdims=True)
        if not (np.isfinite(bones).all() and np.isfinite(total).all() and (total > 0.0).all()):
            self._file.fail("a skin has bind matrices or weights that are not finite, or weights without sum")
        places, weights, anchors = places.astype(np.int64), weights / total, tuple(self._anchors)
        carriers = [place.carrier for place in standing]

        def at(seconds: float) -> Array:
            now = part_transforms(anchors, carriers, seconds) @ bones
            return np.asarray(np.einsum("nj,njab->nab", weights, now[places]), dtype=np.float64)

        return at, max(carriers) >= 0

    # ---- pictures ------------------------------------------------------------------------------------------------

    def _take_image(self, index: int) -> int:
        if index not in self._images:
            data = self._file.image(index)
            width, height = picture_size(data) or (0, 0)
            self._pixels += width * height
            if self._pixels > _MOST_IMAGES * limits().picture_pixels:
                raise SceneError(
                    too_much(f"{self._source.path}: its pictures", self._pixels, "pixels", "picture_pixels")
                )
            self._images[index] = len(self._source.images)
            picture = decode_rgba(data, f"{self._source.path}: its image {index}")
            shown = in_srgb(np.ascontiguousarray(picture[..., :3]), data)
            if np.abs(shown.astype(np.int16) - picture[..., :3]).max(initial=0) > _SAME_COLOR:
                self._source.note("colour profiles of pictures, which glTF has ignored")
            self._source.images.append(picture)
        return self._images[index]


def _bend(
    part: MeshPart, morph: Bending | None, bones: _Bones | None, transform: Array, seconds: float
) -> MeshPart | None:
    """Return a primitive at a time: displaced by its morph targets, then placed by its joints or its node."""
    part = part if morph is None else morph(seconds) or part
    return part.moved(transform) if bones is None else part.bent(bones(seconds))


def _upward(uvs: Array | None) -> Array | None:
    """Return texture coordinates with v pointing up; glTF's v points down."""
    return None if uvs is None else uvs * np.array([1.0, -1.0]) + np.array([0.0, 1.0])
