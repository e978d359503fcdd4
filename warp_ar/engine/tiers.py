"""Two ways to compile kernels: quickly before the first frame, better beside the frames.

Commands begin with kernels into which less is inlined: they take two thirds as long to compile, and a frame a tenth
longer. A process of its own (``better_kernels``) compiles the better ones meanwhile, those first that gain most
(``slow_to_compile``), and the next run finds them. Both compute the same bits, and a process stays with those that it
has begun with. There are two ways only on CPU: NVRTC joins products and sums differently at each of its levels.
"""

from __future__ import annotations

import atexit
import contextlib
import json
import os
import shutil
import subprocess
import sys
import threading
from collections.abc import Iterable
from pathlib import Path
from typing import Any, Final

import warp as wp

from warp_ar.engine.better_kernels import work_at_once, work_folder
from warp_ar.errors import UsageError
from warp_ar.kernels.launch import UNCHECKED, is_slow_to_compile

VARIABLE: Final = "WARP_AR_TIERS"
"""Environment variable: ``one``, kernels as good as they get before the first frame, which is the rule; ``two``, as
commands do; ``quick``, the quick ones and no others, for measuring."""
LEVEL_VARIABLE: Final = "WARP_AR_CUDA_LEVEL"
"""Environment variable, for measuring: NVRTC's level of optimisation, 1 to 3, of all kernels (``2``) or of those whose
names hold one of several words (``2:near_field,mirror_ball``)."""
QUICK_FLAGS: Final = f"-march=native -mllvm=-inline-threshold=225 -fno-slp-vectorize {UNCHECKED}"
"""Of the first way: LLVM's own bound of inlining instead of Warp's 9,000, no vectors of straight code."""

_MODES: Final = ("one", "two", "quick")


class _Beside:
    """The process that compiles better kernels, if any has been asked for."""

    def __init__(self) -> None:
        self.default = "one"
        self.process: subprocess.Popen[bytes] | None = None
        self.wanted: list[tuple[Any, str, str, dict[str, Any]]] = []
        self.lock = threading.Lock()


_BESIDE = _Beside()


def begin_quickly() -> None:
    """Have kernels compiled in two ways from now on. For commands alone: a library starts no processes."""
    _BESIDE.default = "two"


def tiers() -> str:
    """``one``, ``two`` or ``quick``.

    Raises:
        UsageError: The environment variable has another value.
    """
    asked = os.environ.get(VARIABLE, "")
    if asked not in ("", *_MODES):
        raise UsageError(f"{VARIABLE} = {asked!r}: expected {', '.join(_MODES[:-1])} or {_MODES[-1]}")
    return asked or _BESIDE.default


def cuda_level(name: str) -> int | None:
    """Level of optimisation that the environment asks for, for a module of this name; None: the usual.

    Raises:
        UsageError: The environment variable has another form.
    """
    asked = os.environ.get(LEVEL_VARIABLE, "")
    level, _, words = asked.partition(":")
    if asked and level not in ("1", "2", "3"):
        raise UsageError(f"{LEVEL_VARIABLE} = {asked!r}: expected a level of 1 to 3, as in 2 or 2:near_field")
    if not asked or (words and not any(word in name for word in words.split(","))):
        return None
    return int(level)


def choose(kernels: Iterable[wp.Kernel], device: Any) -> None:
    """Decide how the modules of kernels are compiled, as long as none of a module's is loaded; before it is hashed.

    All begin with the same flags: Clang's options belong to the process, and compilers with others would wait.

    Raises:
        UsageError: An environment variable has a value that it cannot have.
    """
    mode = tiers()
    # Those that gain most by being compiled better are first in the queue of the process that does.
    for kernel in sorted(kernels, key=lambda kernel: not is_slow_to_compile(kernel)):
        module = kernel.module
        if any(module.execs.values()):
            continue
        if device.is_cuda:
            level = cuda_level(module.name)
            if level is not None and module.options["optimization_level"] != level:
                _set(module, "optimization_level", level)
        elif mode != "one" and module.options.get("cpu_compiler_flags") != QUICK_FLAGS:
            if mode == "two":
                name = module.get_module_identifier(1)
                if (Path(wp.config.kernel_cache_dir) / name).is_dir() or not wp.config.cache_kernels:
                    continue
                binary = module._get_compile_output_name(device, block_dim=1)
                _BESIDE.wanted.append((module, name, binary, _arguments(module)))
            _set(module, "cpu_compiler_flags", QUICK_FLAGS)


def compile_better(headers: Path | None) -> None:
    """Have what was chosen to begin quickly compiled better, beside what follows. Its quick kernels must be there.

    Args:
        headers: Folder with Warp's headers as this process has parsed them; None: there is none.
    """
    with _BESIDE.lock:
        wanted, _BESIDE.wanted = _BESIDE.wanted, []
        if not wanted or headers is None:
            return
        try:
            process = _process()
            assert process.stdin is not None
            for module, name, binary, arguments in wanted:
                process.stdin.write(json.dumps(_job(module, name, binary, arguments, headers)).encode() + b"\n")
            process.stdin.flush()
        except OSError:
            return  # there is no such process, or it has ended: the quick ones do


def end() -> None:
    """End the process that compiles; what it has not finished is lost."""
    with _BESIDE.lock:
        process, _BESIDE.process = _BESIDE.process, None
        if process is None:
            return
        work_at_once(process.pid)
        process.kill()
        with contextlib.suppress(subprocess.TimeoutExpired):
            process.wait(1.0)
        if process.stdin is not None:
            with contextlib.suppress(OSError):
                process.stdin.close()
        shutil.rmtree(work_folder(Path(wp.config.kernel_cache_dir), process.pid), ignore_errors=True)


def digest(flags: str) -> str:
    """By which Warp names headers: FNV-1a of the flags, a zero byte behind each."""
    value = 0xCBF29CE484222325
    for byte in "".join(f"{word}\0" for word in flags.split()).encode():
        value = (value ^ byte) * 0x100000001B3 % (1 << 64)
    return f"{value:016x}"


def _set(module: Any, option: str, value: object) -> None:
    module.options[option] = value
    module.mark_modified()


def _process() -> subprocess.Popen[bytes]:
    if _BESIDE.process is None:
        from warp_ar.engine import better_kernels

        atexit.register(end)
        script = str(better_kernels.__file__)
        _BESIDE.process = subprocess.Popen(
            [sys.executable, script, str(wp.config.kernel_cache_dir)],
            stdin=subprocess.PIPE,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            start_new_session=True,  # Ctrl-C is for the frames
            creationflags=getattr(subprocess, "IDLE_PRIORITY_CLASS", 0),
        )
    return _BESIDE.process


def _clang() -> Any:
    """Where Warp's Clang lies."""
    context: Any = getattr(getattr(wp, "_src", None), "context", None)
    return context.runtime.llvm._name


def _arguments(module: Any) -> dict[str, Any]:
    """What Warp would call ``build_cpu`` with, beside files."""
    options = module.resolved_options[1]
    level = options["optimization_level"]
    return {
        "mode": options["mode"],
        "fast_math": options["fast_math"],
        "verify_fp": options["verify_fp"],
        "fuse_fp": options["fuse_fp"],
        "extra_flags": options["cpu_compiler_flags"],
        "optimization_level": 2 if level is None else level,
        "use_precompiled_headers": options["use_precompiled_headers"],
        "block_dim": 1,
        "enable_tiles_in_stack_memory": options["enable_tiles_in_stack_memory"],
        "extra_include_dirs": list(options["extra_cpu_include_dirs"]),
    }


def _job(module: Any, name: str, binary: str, arguments: dict[str, Any], headers: Path) -> dict[str, Any]:
    quick = module.get_module_identifier(1)
    folder = Path(wp.config.kernel_cache_dir) / quick
    return {
        "name": name,
        "binary": binary,
        "source": str(folder / f"{quick}.cpp"),
        "meta": str(folder / f"{quick}.meta"),
        "headers": str(headers),
        "flags_digest": digest(arguments["extra_flags"]),
        "library": str(_clang()),
        "arguments": arguments,
    }
