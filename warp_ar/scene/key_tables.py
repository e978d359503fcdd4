"""List of all keys of scene files with meaning, unit, default and a valid example.

Meanings are the docstrings of the dataclasses' fields. Defaults, units and examples are declared at the fields. The
documentation's page of keys is generated from this list, and a test reads every example.
"""

from __future__ import annotations

import ast
import dataclasses
import functools
import inspect
import itertools
import types
from collections.abc import Iterator
from typing import Any, Final

import tomlkit

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
    PoseKeys,
    Probe,
    Proxy,
    ProxyMaterial,
    SourceSpec,
)
from warp_ar.scene.fields import Field, fields_of
from warp_ar.scene.materials import MATERIALS, FileMaterial


@dataclasses.dataclass(frozen=True)
class Key:
    """One key of a scene file."""

    section: str
    """Section that contains the key, without brackets; empty for the top of the file."""
    name: str
    """Name of the key."""
    meaning: str
    """Meaning, one or two sentences."""
    unit: str
    """Unit of the value; a dash if it has none."""
    default: str
    """Default value as TOML, or "required", or "none"."""
    example: str
    """Example of a value, as TOML."""

    @property
    def description(self) -> str:
        """Return the meaning with the unit, if the meaning does not name it."""
        said = self.unit == "-" or self.unit.split()[0].lower().rstrip(",") in self.meaning.lower()
        return self.meaning if said else f"{self.meaning} ({self.unit})"


@dataclasses.dataclass(frozen=True)
class Section:
    """One section of a scene file."""

    name: str
    """Name in the file, without brackets."""
    several: bool
    """True if the section is written ``[[name]]`` and may occur several times."""
    meaning: str
    """Meaning of the section."""
    kinds: tuple[type[Any], ...]
    """Dataclasses into which the section is read."""


SECTIONS: Final[tuple[Section, ...]] = (
    Section(
        "camera", False, "Camera of the frames: its numbers, a calibration file, or a guessed field of view.", (Camera,)
    ),
    Section("source", False, "Source of frames: exactly one of path, camera and synthetic.", (SourceSpec,)),
    Section("marker", False, "Printed marker or board that fixes the world.", (Marker,)),
    Section("probe", True, "A mirror ball.", (Probe,)),
    Section("proxy", True, "Simplified real geometry that receives virtual light and shadow.", (Proxy,)),
    Section("proxy.material", False, "Reflection of virtual things in a proxy.", (ProxyMaterial,)),
    Section("object", True, "A virtual object.", (Object,)),
    Section(
        "object.material",
        False,
        "Reflection or emission of a virtual object.",
        tuple(kind for kind in MATERIALS.values() if kind is not FileMaterial),
    ),
    Section("object.play", False, "Playing of an animation of the object's glTF file.", (Play,)),
    Section("object.animate", False, "Motion of an object; a light's `animate` has the same keys.", (Animation,)),
    Section(
        "light",
        True,
        "A virtual light or, with `file`, the environment's light by `warp_ar.capture`.",
        (Light, CapturedLight, AreaLight),
    ),
    Section("pose", False, "Pose of the camera, instead of a marker.", (PoseKeys,)),
    Section("exposure", False, "A simulated shorter exposure.", (Exposure,)),
)

# Keys that are not fields of a dataclass: example, unit and meaning.
_OTHERS: Final[dict[tuple[str, str], tuple[str, str, str]]] = {
    ("camera", "calibration"): (
        '"camera.yml"',
        "-",
        'Calibration file instead of the numbers; "exif": EXIF of the source\'s first picture.',
    ),
    ("object.material", "model"): (
        '"metallic_roughness"',
        "-",
        "Reflection model, one of " + ", ".join(MATERIALS) + "; each has keys of its own.",
    ),
}


@functools.cache
def _classes(module: types.ModuleType) -> dict[str, ast.ClassDef]:
    """Return the syntax trees of a module's classes.

    The result is cached, because parsing takes a tenth of a second and every key needs it.
    """
    return {node.name: node for node in ast.parse(inspect.getsource(module)).body if isinstance(node, ast.ClassDef)}


def field_docs(kind: type[Any]) -> dict[str, str]:
    """Return the docstrings of a dataclass's fields: the string literals below them."""
    body = _classes(inspect.getmodule(kind) or description)[kind.__name__].body
    found: dict[str, str] = {}
    for node, below in itertools.pairwise(body):
        if not isinstance(node, ast.AnnAssign) or not isinstance(node.target, ast.Name):
            continue
        if isinstance(below, ast.Expr) and isinstance(below.value, ast.Constant) and isinstance(below.value.value, str):
            found[node.target.id] = " ".join(below.value.value.split())
    return found


def keys() -> Iterator[Key]:
    """Yield every key of a scene file, in the order of the sections and their fields."""
    yield Key("", "schema", "Version of the format.", "-", "required", str(description.SCHEMA))
    yield Key("", "name", "Name to show.", "-", "the file's own", '"my desk"')
    for section in SECTIONS:
        for (own, name), (example, unit, meaning) in _OTHERS.items():
            if own == section.name:
                yield Key(own, name, meaning, unit, "required" if name == "model" else "none", example)
        for name in dict.fromkeys(name for kind in section.kinds for name in fields_of(kind)):
            kinds = [kind for kind in section.kinds if name in fields_of(kind)]
            meaning = " / ".join(dict.fromkeys(field_docs(kind)[name] for kind in kinds))
            defaults = [_toml(fields_of(kind)[name]) for kind in kinds]
            key = fields_of(kinds[0])[name].key
            default = " or ".join(dict.fromkeys(defaults))
            yield Key(section.name, name, meaning, key.unit, default, key.example)


def _toml(field: Field) -> str:
    """Return a field's default as TOML."""
    value = field.default
    if field.key.required or value is dataclasses.MISSING:
        return "required"
    if value is None:
        return "none"
    return "that of its file" if isinstance(value, FileMaterial) else tomlkit.item(value).as_string()


def as_markdown() -> str:
    """Return the Markdown page of keys: a list for every section, with an example of each key."""
    own = list(keys())
    parts: list[str] = []
    for name in ["", *(section.name for section in SECTIONS)]:
        section = next((section for section in SECTIONS if section.name == name), None)
        title = "Top of the file" if section is None else f"[[{name}]]" if section.several else f"[{name}]"
        parts += [f"## {title}" if section is None else f"## `{title}`", ""]
        parts += [section.meaning, ""] if section is not None else []
        for key in own:
            if key.section == name:
                usual = {"required": " Required.", "none": ""}.get(key.default, f" Default `{key.default}`.")
                parts.append(f"- `{key.name} = {key.example}`: {key.description}{usual}")
        parts.append("")
    return "\n".join(parts).replace("``", "`")
