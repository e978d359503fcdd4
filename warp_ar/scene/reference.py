"""Every key of a scene file with meaning, unit, default and an example that the reader accepts.

Meanings are the docstrings of the dataclasses' fields, defaults are the fields' own; units and examples stand here. The
documentation's page of keys is made from this list, and a test reads every example.
"""

from __future__ import annotations

import ast
import dataclasses
import functools
import inspect
import itertools
import types
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Final

from warp_ar.scene import description
from warp_ar.scene.description import (
    Animation,
    AreaLight,
    Camera,
    CapturedLight,
    Exposure,
    Light,
    Marker,
    Object,
    Play,
    Probe,
    Proxy,
    ProxyMaterial,
    SourceSpec,
)
from warp_ar.scene.materials import (
    EmissiveMaterial,
    LambertMaterial,
    MetallicRoughnessMaterial,
    MirrorMaterial,
    PhongMaterial,
)


@dataclasses.dataclass(frozen=True)
class Key:
    """One key of a scene file."""

    section: str
    """Section that the key stands in, without brackets; empty at the top of the file."""
    name: str
    """The key."""
    meaning: str
    """What it says, one or two sentences."""
    unit: str
    """Unit of its value; a dash where it has none."""
    default: str
    """Value in a file that leaves the key out, as TOML; "required", or "none" where nothing is assumed."""
    example: str
    """A value as TOML."""
    beside: str = ""
    """Other keys of the section, as lines of TOML, without which the example is not complete."""


@dataclasses.dataclass(frozen=True)
class Section:
    """One section of a scene file."""

    name: str
    """As in the file, without brackets."""
    several: bool
    """Whether it is written ``[[name]]`` and may stand there more than once."""
    meaning: str
    """What it describes."""
    kinds: tuple[type[Any], ...]
    """Dataclasses that it is read into."""


SECTIONS: Final[tuple[Section, ...]] = (
    Section("camera", False, "The camera that the frames come from. Intrinsics, or a file with them.", (Camera,)),
    Section("source", False, "Where frames come from: exactly one of path, camera and synthetic.", (SourceSpec,)),
    Section("marker", False, "The printed marker or board that the world is fixed to.", (Marker,)),
    Section("probe", True, "A mirror ball; a single one may be written [probe].", (Probe,)),
    Section("proxy", True, "Simplified physical geometry that receives virtual light and shadow.", (Proxy,)),
    Section("proxy.material", False, "How a proxy mirrors what is virtual.", (ProxyMaterial,)),
    Section("object", True, "A virtual object.", (Object,)),
    Section(
        "object.material",
        False,
        "How a virtual object reflects light, or sends it out.",
        (PhongMaterial, MetallicRoughnessMaterial, LambertMaterial, MirrorMaterial, EmissiveMaterial),
    ),
    Section("object.play", False, "How an animation of the object's glTF file is played.", (Play,)),
    Section("object.animate", False, "Motion of an object; a light's `animate` has the same keys.", (Animation,)),
    Section(
        "light",
        True,
        "A virtual light or, with `file`, the environment's light as `warp_ar.capture` wrote it; one may be [light].",
        (Light, AreaLight, CapturedLight),
    ),
    Section("pose", False, "Where the camera stands, where no marker tells.", ()),
    Section("exposure", False, "A simulated shorter exposure.", (Exposure,)),
)

INTRINSICS = "width = 640\nheight = 480\nfx = 640.0\nfy = 640.0\ncx = 319.5\ncy = 239.5"
"""Of any camera, for examples."""

# (section, key): unit, example, and the other keys that the example needs.
_EXAMPLES: Final[dict[tuple[str, str], tuple[str, str, str]]] = {
    ("camera", "width"): ("pixels", "640", "height = 480\nfx = 640.0\nfy = 640.0\ncx = 319.5\ncy = 239.5"),
    ("camera", "height"): ("pixels", "480", "width = 640\nfx = 640.0\nfy = 640.0\ncx = 319.5\ncy = 239.5"),
    ("camera", "fx"): ("pixels", "640.0", "width = 640\nheight = 480\nfy = 640.0\ncx = 319.5\ncy = 239.5"),
    ("camera", "fy"): ("pixels", "640.0", "width = 640\nheight = 480\nfx = 640.0\ncx = 319.5\ncy = 239.5"),
    ("camera", "cx"): ("pixels", "319.5", "width = 640\nheight = 480\nfx = 640.0\nfy = 640.0\ncy = 239.5"),
    ("camera", "cy"): ("pixels", "239.5", "width = 640\nheight = 480\nfx = 640.0\nfy = 640.0\ncx = 319.5"),
    ("camera", "distortion"): ("-", "[-0.12, 0.05, 0.0, 0.0, 0.0]", INTRINSICS),
    ("camera", "transfer"): ("-", '"gamma:2.2"', INTRINSICS),
    ("camera", "calibration"): ("-", '"camera.yml"', ""),
    ("camera", "field_of_view"): ("degrees", "60.0", ""),
    ("source", "path"): ("-", '"frames"', ""),
    ("source", "camera"): ("-", "0", ""),
    ("source", "synthetic"): ("-", '"moving_card"', ""),
    ("source", "fps"): ("frames per second", "24.0", 'path = "frames"'),
    ("source", "exposures"): ("seconds", "[0.016, 0.001]", "camera = 0"),
    ("source", "shown"): ("seconds", "0.001", "camera = 0\nexposures = [0.016, 0.001]"),
    ("source", "metering"): ("-", '"automatic"', "camera = 0"),
    ("marker", "dictionary"): ("-", '"DICT_APRILTAG_36h11"', "size = 0.08"),
    ("marker", "id"): ("-", "7", "size = 0.08"),
    ("marker", "size"): ("metres", "0.08", ""),
    ("marker", "white"): ("reflectance, 0 to 1", "0.85", "size = 0.08"),
    ("marker", "board"): ("metres", '"charuco 5x7 0.035 0.026"', ""),
    ("probe", "center"): ("metres", "[-0.12, 0.03, 0.0346]", "radius = 0.035"),
    ("probe", "radius"): ("metres", "0.035", "center = [-0.12, 0.03, 0.0346]"),
    ("probe", "reflectance"): ("0 to 1 per channel", "[0.85, 0.85, 0.87]", "center = [0.1, 0.0, 0.03]\nradius = 0.03"),
    ("probe", "marker"): ("-", "{ id = 7, size = 0.05 }", "center = [0.0, 0.06, 0.0346]\nradius = 0.035"),
    ("proxy", "shape"): ("-", '"plane"', "size = [1.6, 1.2]"),
    ("proxy", "at"): ("metres", "[0.0, 0.21, 0.0446]", 'shape = "plane"\nsize = [1.6, 1.2]'),
    ("proxy", "rotate"): ("degrees", "[0.0, 0.0, 9.0]", 'shape = "plane"\nsize = [1.6, 1.2]'),
    ("proxy", "size"): ("metres", "[0.2, 0.075, 0.09]", 'shape = "box"'),
    ("proxy", "file"): ("metres inside", '"table.ply"', 'shape = "mesh"'),
    ("proxy", "marker"): ("-", "{ id = 7, size = 0.05 }", 'shape = "box"\nsize = [0.1, 0.1, 0.1]'),
    ("proxy", "material"): ("-", "{ roughness = 0.1 }", 'shape = "plane"\nsize = [1.6, 1.2]'),
    ("proxy.material", "roughness"): ("0 to 1", "0.05", ""),
    ("proxy.material", "reflectance"): ("0 to 1 per channel", "[0.04, 0.04, 0.05]", "roughness = 0.05"),
    ("object", "shape"): ("-", '"sphere"', "radius = 0.03"),
    ("object", "file"): ("metres inside", '"table.ply"', 'shape = "mesh"'),
    ("object", "radius"): ("metres", "0.03", 'shape = "sphere"'),
    ("object", "length"): ("metres", "0.2", 'shape = "tube"\nradius = 0.01'),
    ("object", "size"): ("metres", "[0.1, 0.05, 0.04]", 'shape = "box"'),
    ("object", "major_radius"): ("metres", "0.05", 'shape = "torus"\nminor_radius = 0.02'),
    ("object", "minor_radius"): ("metres", "0.02", 'shape = "torus"\nmajor_radius = 0.05'),
    ("object", "at"): ("metres", "[0.15, 0.055, 0.03]", 'shape = "sphere"\nradius = 0.03'),
    ("object", "rotate"): ("degrees", "[0.0, 0.0, -25.0]", 'shape = "sphere"\nradius = 0.03'),
    ("object", "scale"): ("-", "0.026", 'shape = "sphere"\nradius = 1.0'),
    ("object", "material"): ("-", '{ model = "mirror" }', 'shape = "sphere"\nradius = 0.03'),
    ("object", "animate"): ("-", "{ turn = [0.0, 0.0, 30.0] }", 'shape = "sphere"\nradius = 0.03'),
    ("object", "marker"): ("-", "{ id = 7, size = 0.05 }", 'shape = "sphere"\nradius = 0.03'),
    ("object.material", "model"): ("-", '"metallic_roughness"', ""),
    ("object.material", "diffuse"): ("linear RGB, 0 to 1", "[0.8, 0.2, 0.2]", 'model = "phong"'),
    ("object.material", "specular"): ("linear RGB, 0 to 1", "[0.2, 0.2, 0.2]", 'model = "phong"'),
    ("object.material", "shininess"): ("-", "64.0", 'model = "phong"'),
    ("object.material", "base_color"): ("linear RGB, 0 to 1", "[1.0, 0.77, 0.34]", 'model = "metallic_roughness"'),
    ("object.material", "metallic"): ("0 to 1", "1.0", 'model = "metallic_roughness"'),
    ("object.material", "roughness"): ("0 to 1", "0.25", 'model = "metallic_roughness"'),
    ("object.material", "color"): ("linear RGB", "[1.0, 0.9, 0.7]", 'model = "emissive"'),
    ("object.material", "intensity"): ("camera values", "4.0", 'model = "emissive"'),
    ("object.material", "image"): ("-", '"picture.png"', 'model = "emissive"'),
    ("object.material", "two_sided"): ("-", "true", 'model = "emissive"'),
    ("object", "play"): ("-", "{ animation = 0 }", 'shape = "mesh"\nfile = "watch.glb"'),
    ("object.play", "animation"): ("-", '"Open"', ""),
    ("object.play", "loop"): ("-", "false", ""),
    ("object.play", "start"): ("seconds", "2.0", ""),
    ("object.play", "speed"): ("-", "0.5", ""),
    ("object.play", "offset"): ("seconds", "1.5", ""),
    ("object.play", "paused"): ("-", "true", ""),
    ("object.animate", "turn"): ("degrees per second", "[0.0, 0.0, 30.0]", ""),
    ("object.animate", "pivot"): ("metres", "[0.0, 0.0, 0.0]", "turn = [0.0, 0.0, 30.0]"),
    ("object.animate", "sway"): ("metres", "[0.02, 0.0, 0.0]", ""),
    ("object.animate", "period"): ("seconds", "3.0", "sway = [0.02, 0.0, 0.0]"),
    ("light", "kind"): ("-", '"point"', "at = [0.0, 0.0, 0.4]\nintensity = 2.0"),
    ("light", "intensity"): ("camera values", "2.2", 'kind = "point"\nat = [0.0, 0.0, 0.4]'),
    ("light", "color"): ("linear RGB", "[0.06, 0.26, 1.0]", 'kind = "point"\nat = [0.0, 0.0, 0.4]\nintensity = 2.0'),
    ("light", "at"): ("metres", "[0.07, -0.06, 0.4]", 'kind = "point"\nintensity = 2.0'),
    ("light", "target"): (
        "metres",
        "[0.135, 0.04, 0.01]",
        'kind = "spot"\nat = [0.0, 0.0, 0.4]\nintensity = 2.0\ninner_angle = 13.0\nouter_angle = 21.0',
    ),
    ("light", "direction"): ("-", "[0.3, 0.0, -1.0]", 'kind = "directional"\nintensity = 1.0'),
    ("light", "inner_angle"): (
        "degrees",
        "13.0",
        'kind = "spot"\nat = [0.0, 0.0, 0.4]\ntarget = [0.0, 0.0, 0.0]\nintensity = 2.0\nouter_angle = 21.0',
    ),
    ("light", "outer_angle"): (
        "degrees",
        "21.0",
        'kind = "spot"\nat = [0.0, 0.0, 0.4]\ntarget = [0.0, 0.0, 0.0]\nintensity = 2.0\ninner_angle = 13.0',
    ),
    ("light", "attenuation"): ("1, 1/m, 1/m²", "[0.0, 0.0, 1.0]", 'kind = "point"\nat = [0, 0, 0.4]\nintensity = 2.0'),
    ("light", "radius"): ("metres", "0.02", 'kind = "point"\nat = [0.0, 0.0, 0.4]\nintensity = 2.0'),
    ("light", "size"): ("metres", "[0.2, 0.1]", 'kind = "rect"\nat = [0.0, 0.0, 0.4]\nintensity = 2.0'),
    ("light", "length"): ("metres", "0.3", 'kind = "tube"\nradius = 0.01\nat = [0.0, 0.0, 0.4]\nintensity = 2.0'),
    ("light", "image"): (
        "-",
        '"picture.png"',
        'kind = "rect"\nsize = [0.2, 0.1]\nat = [0.0, 0.0, 0.4]\nintensity = 2.0',
    ),
    ("light", "two_sided"): (
        "-",
        "true",
        'kind = "rect"\nsize = [0.2, 0.1]\nat = [0.0, 0.0, 0.4]\nintensity = 2.0',
    ),
    ("light", "animate"): (
        "-",
        "{ sway = [0.05, 0.0, 0.0] }",
        'kind = "point"\nat = [0.0, 0.0, 0.4]\nintensity = 2.0',
    ),
    ("light", "marker"): ("-", "{ id = 7 }", 'kind = "point"\nat = [0.0, 0.0, 0.4]\nintensity = 2.0'),
    ("light", "file"): ("-", '"light.exr"', ""),
    ("light", "scale"): ("-", "0.5", 'file = "light.exr"'),
    ("light", "rotate"): ("degrees", "[0.0, 0.0, 30.0]", 'file = "light.exr"'),
    ("light", "axes"): ("-", '"y-up"', 'file = "light.exr"'),
    ("pose", "R"): ("-", "[1, 0, 0, 0, 0, -1, 0, 1, 0]", "t = [0.0, 0.1, 0.6]"),
    ("pose", "t"): ("metres", "[0.0, 0.1, 0.6]", "R = [1, 0, 0, 0, 0, -1, 0, 1, 0]"),
    ("pose", "quaternion"): ("-", "[0.7, 0.7, 0.0, 0.0]", "t = [0.0, 0.1, 0.6]"),
    ("pose", "position"): ("metres", "[0.0, -0.6, 0.1]", ""),
    ("pose", "rotate"): ("degrees", "[-20.0, 0.0, 0.0]", "position = [0.0, -0.6, 0.3]"),
    ("pose", "file"): ("-", '"images.txt"', ""),
    ("exposure", "scale"): ("-", "0.5", ""),
}

# Keys that are no fields of a dataclass.
_MEANINGS: Final[dict[tuple[str, str], str]] = {
    ("camera", "calibration"): (
        "A calibration file, OpenCV's YAML, JSON or XML, instead of the numbers; `exif`: EXIF of [source] path's first."
    ),
    ("pose", "R"): "Rotation of camera_from_world, row by row, as OpenCV has it: x right, y down, z forward.",
    ("pose", "t"): "Translation of camera_from_world, beside R or quaternion.",
    ("pose", "quaternion"): "Rotation of camera_from_world as COLMAP has it: w, x, y, z.",
    ("pose", "position"): "Where the camera stands, instead of camera_from_world.",
    ("pose", "rotate"): "About the fixed x, then y, then z axis, from a level camera that looks along +y.",
    ("pose", "file"): "A pose for every frame: COLMAP's images.txt or .bin, JSON of R and t, OpenTrackIO, or USD.",
    ("object.material", "model"): "The reflection model; each has keys of its own.",
}


@functools.cache
def _classes(module: types.ModuleType) -> dict[str, ast.ClassDef]:
    """Syntax of a module's classes. To parse a module takes a tenth of a second, and each key asks."""
    return {node.name: node for node in ast.parse(inspect.getsource(module)).body if isinstance(node, ast.ClassDef)}


def field_docs(kind: type[Any]) -> dict[str, str]:
    """Docstrings of a dataclass's fields: the strings that stand below them."""
    body = _classes(inspect.getmodule(kind) or description)[kind.__name__].body
    found: dict[str, str] = {}
    for node, below in itertools.pairwise(body):
        if not isinstance(node, ast.AnnAssign) or not isinstance(node.target, ast.Name):
            continue
        if isinstance(below, ast.Expr) and isinstance(below.value, ast.Constant) and isinstance(below.value.value, str):
            found[node.target.id] = " ".join(below.value.value.split())
    return found


def keys() -> Iterator[Key]:
    """Every key of a scene file, in the order of the sections and their fields."""
    yield Key("", "schema", "Version of the format.", "-", "required", str(description.SCHEMA))
    yield Key("", "name", "Name to show.", "-", "the file's own", '"my desk"')
    for section in SECTIONS:
        names = [name for own, name in _EXAMPLES if own == section.name]
        for name in names:
            unit, example, beside = _EXAMPLES[section.name, name]
            meanings = [field_docs(kind)[name] for kind in section.kinds if name in field_docs(kind)]
            meaning = _MEANINGS.get((section.name, name)) or " / ".join(dict.fromkeys(meanings))
            yield Key(section.name, name, meaning, unit, _default(section, name), example, beside)


def _default(section: Section, name: str) -> str:
    """Default of a field as TOML."""
    if (section.name, name) in (("marker", "size"), ("exposure", "scale")):
        return "required" if name == "size" else "1.0"
    fields = [field for kind in section.kinds for field in dataclasses.fields(kind) if field.name == name]
    if not fields:
        return "none" if name == "calibration" or section.name == "pose" else "required"
    values = list(dict.fromkeys(_toml(field.default) for field in fields))
    return " or ".join(values)


def _toml(value: object) -> str:
    """A default as a TOML file has it."""
    if value is dataclasses.MISSING:
        return "required"
    if value is None or value == () or (value == 0.0 and isinstance(value, float)):
        return "none" if value is None or value == () else "0.0"
    if isinstance(value, str | Path):
        return f'"{value}"'
    if isinstance(value, tuple):
        return "[" + ", ".join(_toml(item) for item in value) + "]"
    return type(value).__name__ if dataclasses.is_dataclass(value) else repr(value)


def as_markdown() -> str:
    """The page of keys: a table for every section."""
    own = list(keys())
    parts: list[str] = []
    for name in ["", *(section.name for section in SECTIONS)]:
        section = next((section for section in SECTIONS if section.name == name), None)
        title = "Top of the file" if section is None else f"[[{name}]]" if section.several else f"[{name}]"
        parts += [f"## {title}" if section is None else f"## `{title}`", ""]
        parts += [section.meaning, ""] if section is not None else []
        parts += ["| key | meaning | unit | default | example |", "| --- | --- | --- | --- | --- |"]
        for key in own:
            if key.section == name:
                cells = [f"`{key.name}`", key.meaning, key.unit, f"`{key.default}`", f"`{key.example}`"]
                parts.append("| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |")
        parts.append("")
    return "\n".join(parts)
