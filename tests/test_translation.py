"""Shortcuts through Warp's translation: what it writes is the same to the byte."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

WRITTEN = """
import hashlib, json, sys
import warp as wp
from warp_ar.engine import scheduler, translation
from warp_ar.engine.pipeline import Pipeline

if sys.argv[1] == "short":
    for _ in range(2):  # again changes nothing
        translation.remember_references()
        translation.remember_overloads()
        translation.remember_functions()
tried = functions = 0
match = wp._src.codegen.func_match_args

def counted(*given, **named):
    global tried
    tried += 1
    return match(*given, **named)

wp._src.codegen.func_match_args = counted
emit = wp._src.codegen.Adjoint.emit_FunctionDef

def emitted(adj, node):
    global functions
    functions += 1
    return emit(adj, node)

wp._src.codegen.Adjoint.emit_FunctionDef = emitted
wp._src.codegen.Adjoint.node_visitors[wp._src.codegen.ast.FunctionDef] = emitted
written = {}

def translate(kernels, device, progress=None, **_):
    found = dict.fromkeys(kernel.module for kernel in kernels)
    for target, size in ((True, 1), (False, 256)):
        for module in found:
            options = module.resolve_options(wp.config, block_dim=size)
            name = module.get_module_identifier(size)
            text, _, meta, *links = module._run_codegen(options | {"output_arch": None if target else 90}, target)
            said = json.dumps([text, meta, [len(link) for link in links]])
            written[f"{name} {target}"] = hashlib.sha256(said.encode()).hexdigest()
    raise KeyboardInterrupt

scheduler.load_modules = translate
for scene, quality in (("desk", "medium"), ("torus", "high")):
    try:
        Pipeline(scene, device="cpu", quality=quality).warm_up()
    except KeyboardInterrupt:
        pass
print(json.dumps([written, tried, functions]))
"""


def test_what_is_written_is_the_same_to_the_byte(tmp_path: Path) -> None:
    """For both targets, of two plans; overloads are tried half as often at most, and a third of the functions rest."""
    script = tmp_path / "script.py"
    script.write_text(WRITTEN)
    environment = {**os.environ, "PYTHONPATH": str(Path(__file__).parents[1])}

    def run(how: str) -> tuple[dict[str, str], int, int]:
        command = [sys.executable, str(script), how]
        output = subprocess.run(command, env=environment, capture_output=True, text=True, check=True).stdout
        written, tried, functions = json.loads(output.splitlines()[-1])
        return written, tried, functions

    (usual, often, all_functions), (short, once, few_functions) = run("usual"), run("short")
    assert len(usual) > 70
    assert short == usual
    assert once < 0.5 * often
    assert few_functions < 0.67 * all_functions


NAMES = """
import sys
import warp as wp
from warp_ar.engine import translation

calls = 0
find = wp._src.codegen.Adjoint.get_references

def counted(adj):
    global calls
    calls += 1
    return find(adj)

wp._src.codegen.Adjoint.get_references = counted
if sys.argv[1] == "once":
    translation.remember_references()
    translation.remember_references()  # again changes nothing

from warp_ar.engine import scheduler
from warp_ar.engine.pipeline import Pipeline

def named(kernels, device, progress=None, **_):
    for kernel in kernels:
        print(kernel.module.get_module_identifier(1))
    print(calls)
    sys.exit()

scheduler.load_modules = named
Pipeline("desk", device="cpu").warm_up()
"""


def test_remembered_references_name_the_same_kernels(tmp_path: Path) -> None:
    """What is compiled and cached has the same names, found with half the looking at most."""
    script = tmp_path / "script.py"
    script.write_text(NAMES)
    environment = {**os.environ, "PYTHONPATH": str(Path(__file__).parents[1])}

    def run(how: str) -> tuple[list[str], int]:
        command = [sys.executable, str(script), how]
        lines = subprocess.run(command, env=environment, capture_output=True, text=True, check=True).stdout.split()
        return lines[:-1], int(lines[-1])

    (usual, often), (remembered, once) = run("often"), run("once")
    assert len(usual) > 20
    assert remembered == usual
    assert once < 0.5 * often


ADJOINTS = """
import sys
from pathlib import Path
import warp as wp
from warp_ar.device import start_warp
from warp_ar.engine import translation

start_warp()

@wp.struct
class Pair:
    first: wp.float32
    second: wp.vec3

@wp.kernel(module="unique", enable_backward=False)
def pair_kernel(pairs: wp.array[Pair], sums_out: wp.array[wp.float32]):
    pair = pairs[0]
    sums_out[0] = pair.first + pair.second[1]

if sys.argv[1] == "dropped":
    translation.drop_unused_adjoints()
    translation.drop_unused_adjoints()  # again changes nothing
pair = Pair()
pair.first, pair.second = 1.0, wp.vec3(0.0, 2.0, 0.0)
pairs, sums = wp.array([pair], dtype=Pair, device="cpu"), wp.zeros(1, dtype=wp.float32, device="cpu")
wp.launch(pair_kernel, 1, [pairs], [sums], device="cpu")
(binary,) = Path(wp.config.kernel_cache_dir).glob("wp_pair_kernel*/*.o")
print(sums.numpy()[0], binary.parent.name, b"adj_atomic_add" in binary.read_bytes())
"""


def test_sums_and_adjoints_of_structs_that_nothing_calls_are_not_compiled(tmp_path: Path) -> None:
    """The kernel computes the same, and has the same name in the cache."""
    script = tmp_path / "script.py"
    script.write_text(ADJOINTS)

    def run(how: str) -> list[str]:
        environment = {**os.environ, "WARP_CACHE_PATH": str(tmp_path / how)}
        environment["PYTHONPATH"] = str(Path(__file__).parents[1])
        command = [sys.executable, str(script), how]
        lines = subprocess.run(command, env=environment, capture_output=True, text=True, check=True).stdout.splitlines()
        return lines[-1].split()

    usual, dropped = run("usual"), run("dropped")
    assert usual[2] == "True"
    assert dropped == [*usual[:2], "False"]
    assert usual[0] == "3.0"
