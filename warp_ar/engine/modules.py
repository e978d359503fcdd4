"""Compiling and loading the kernels of a plan: side by side, longest first, with word of how far it is.

Warp translates Python to C++ in one thread at a time and leaves its compilers, which take most of the time, to run
beside it. Each thread of a process has Clang parse Warp's headers anew, for 1.5 s, before it compiles its first module;
here they are parsed once, with the templates that they call for, and kept beside the compiled kernels. Modules of the
same flags follow each other: Clang's options belong to the process, so that compilers with other flags would wait for
each other.
"""

from __future__ import annotations

import atexit
import contextlib
import hashlib
import os
import shutil
import tempfile
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor, as_completed
from pathlib import Path
from typing import Any

import warp as wp

from warp_ar.device import compiling, exclusive, usable_cores
from warp_ar.engine import ahead
from warp_ar.engine.nvrtc import HERE, Compilers, compiles_beside, count_processes
from warp_ar.engine.tiers import QUICK_FLAGS, choose, compile_better, digest
from warp_ar.kernels.launch import UNCHECKED

Progress = Callable[[int, int], None]
"""Told how many of how many modules are compiled, first with 0; not called where all were compiled before."""

_AHEAD: list[threading.Thread] = []
"""Threads that parse headers before there is anything to compile."""
_INSTANTIATE = "-fpch-instantiate-templates"
"""Clang's flag with which headers are parsed: what they call for of their own templates is made once, with them, not in
every module. Modules that are compiled without it take such headers, and give the same binary to the byte."""
_LONGEST = ("trace_secondary", "near_field", "mirror_ball", "shade_kernel")
"""Words in the names of modules that take NVRTC longest: 3.3, 3.0, 2.7 and 1.6 s of 22 s for 35 (``torus``, ``high``)
or 41 (``desk``, ``medium``). Begun last, one of them would go on alone for seconds."""
_HEADER_WAIT = 10.0
"""Seconds that a thread waits for another's headers before it parses them itself."""


def load_modules(
    kernels: Iterable[wp.Kernel],
    device: Any,
    progress: Progress | None = None,
    *,
    blocks: Iterable[tuple[wp.Kernel, int]] = (),
    on_host: Iterable[wp.Kernel] = (),
) -> None:
    """Compile the modules of ``kernels`` where they are not in the cache, and load them.

    Args:
        kernels: Of a plan, in the order of its stages.
        device: Warp device.
        progress: Told after each module; on the caller's thread.
        blocks: Kernels that CUDA runs in blocks of another size than its usual one, and that size.
        on_host: Kernels that the CPU runs, whatever the device.
    """
    kernels, blocks, on_host = list(kernels), list(blocks), list(on_host)
    if device.is_cpu:
        kernels, on_host = [*on_host, *kernels], []
    found: dict[tuple[Any, int | None], None] = dict.fromkeys((kernel.module, None) for kernel in kernels)
    found |= dict.fromkeys(((kernel.module, size) for kernel, size in blocks))
    with compiling():
        choose([*kernels, *(kernel for kernel, _ in blocks)], device)
        with _loading_on_host(on_host):
            _compile_missing(found, device, progress)
        for module, size in found:
            with exclusive(device):
                _load(module, device, size)
        if device.is_cpu:
            compile_better(_Headers([]).store)


def _compile_missing(found: Iterable[tuple[Any, int | None]], device: Any, progress: Progress | None) -> None:
    missing = [variant for variant in found if not _is_cached(*variant, device)]
    if missing:
        # The last stages have the longest kernels: begun last they would keep one thread busy alone.
        _compile(missing[::-1], device, progress)


@contextlib.contextmanager
def _loading_on_host(kernels: list[wp.Kernel]) -> Iterator[None]:
    """Have kernels loaded on the CPU beside what is done meanwhile, and compiled where they are not in the cache."""
    if not kernels:
        yield
        return

    def load() -> None:
        headers = _Headers({_flags(kernel.module) for kernel in kernels})
        for kernel in kernels:
            with headers.shared(_flags(kernel.module)):
                _load(kernel.module, wp.get_device("cpu"))
        headers.close()

    with ThreadPoolExecutor(1, "warp_ar-load") as pool:
        loading = pool.submit(load)
        yield
        loading.result()


def begin_slowest(kernels: Iterable[wp.Kernel], device: Any) -> None:
    """Have kernels compiled beside what follows, where it is a command's and they are not in the cache. CUDA only.

    A library's pipeline may never light a frame.

    Args:
        kernels: Each the one of its module, launched in blocks of the usual size; the caller holds ``translating``.
        device: Warp device.
    """
    kernels = list(kernels)
    if device.is_cpu or not compiles_beside() or not wp.config.cache_kernels:
        return
    choose(kernels, device)
    missing: list[tuple[Any, int | None]] = [
        (kernel.module, None) for kernel in kernels if not _is_cached(kernel.module, None, device)
    ]
    ahead.begin([module for module, _ in _longest_first(missing)], device)


def load_at_once(kernel: wp.Kernel, device: Any) -> None:
    """Compile a kernel that runs while a pipeline is built, unless it is in the cache, and load it.

    Its first launch would compile it too, but would parse Warp's headers for that, though they are there.

    Args:
        kernel: The one of its module, or one of several.
        device: Warp device.
    """
    with compiling():
        if not any(kernel.module.execs.values()) and not _is_cached(kernel.module, None, device):
            _compile([(kernel.module, None)], device, None)
        with exclusive(device):
            _load(kernel.module, device)


def parse_headers_ahead() -> None:
    """Have Warp's headers parsed beside what this thread imports and builds, where no earlier run has left them.

    Clang takes 1.4 s for them before it compiles the first kernel of an empty cache, and leaves Python to others
    meanwhile. Warp must have been started.
    """
    build = getattr(getattr(getattr(wp, "_src", None), "build", None), "build_cpu", None)
    headers = _Headers([])
    if build is None or not headers.missing or any(thread.is_alive() for thread in _AHEAD):
        return
    # No daemon: a process that ends sooner waits, so that no files are left.
    _AHEAD.append(threading.Thread(target=headers.parse, args=(build,), name="warp_ar-headers"))
    _AHEAD[-1].start()


def _compile(variants: list[tuple[Any, int | None]], device: Any, progress: Progress | None) -> None:
    """Compile modules, each for a size of block; None means the usual one."""
    cores = usable_cores()
    if device.is_cpu:
        parse_headers_ahead()  # the first module would have to wait for them, too
    while _AHEAD:
        _AHEAD.pop().join()
    headers = _Headers({_flags(module) for module, _ in variants}) if device.is_cpu else None
    total = len(variants)
    begun = {variant: job for variant in variants if variant[1] is None and (job := ahead.take(variant[0])) is not None}
    variants = [variant for variant in variants if variant not in begun]
    free = max(cores - len(begun), 1)
    processes = 0 if device.is_cpu else count_processes(len(variants), free)
    compilers = Compilers(processes, max(HERE - len(begun), 0))
    variants = _by_flags(variants) if device.is_cpu else _longest_first(variants)

    def work(module: Any, size: int | None) -> None:
        with headers.shared(_flags(module)) if headers is not None else compilers.used():
            if device.is_cpu:
                _load(module, device)
            elif size is None:
                wp.compile_aot_module(module, device=device)
            else:
                _compile_blocks(module, device, size)

    if progress is not None:
        progress(0, total)
    try:
        with ThreadPoolExecutor(max(min(free, len(variants)), 1), "warp_ar-compile") as pool:
            try:
                jobs = [*begun.values(), *(pool.submit(work, *variant) for variant in variants)]
                for done, job in enumerate(as_completed(jobs), 1):
                    job.result()
                    if progress is not None:
                        progress(done, total)
            except BaseException:
                pool.shutdown(wait=False, cancel_futures=True)  # who interrupts this does not wait for all the others
                raise
    finally:
        compilers.close()
        if headers is not None:
            headers.close()


def _flags(module: Any) -> str:
    """What Clang is called with for a module."""
    own = module.options.get("cpu_compiler_flags")
    return str(wp.config.cpu_compiler_flags if own is None else own)


def _by_flags(variants: list[tuple[Any, int | None]]) -> list[tuple[Any, int | None]]:
    """Modules of the same flags after each other: first the quick ones, then those that have flags of their own."""
    quick = any(module.options.get("cpu_compiler_flags") == QUICK_FLAGS for module, _ in variants)
    order = {QUICK_FLAGS: 0, None: 2 if quick else 0}
    return sorted(variants, key=lambda variant: order.get(variant[0].options.get("cpu_compiler_flags"), 1))


def _longest_first(variants: list[tuple[Any, int | None]]) -> list[tuple[Any, int | None]]:
    """Modules that take NVRTC longest before all others, which keep their order."""

    def place(variant: tuple[Any, int | None]) -> int:
        return next((place for place, word in enumerate(_LONGEST) if word in variant[0].name), len(_LONGEST))

    return sorted(variants, key=place)


def _compile_blocks(module: Any, device: Any, size: int) -> None:
    """Compile a module for CUDA blocks of a size that is not its usual one, as its first launch would."""
    compile_module = getattr(module, "_compile", None)
    if compile_module is not None:
        compile_module(device, options=module.resolve_options(wp.config, block_dim=size))


def _load(module: Any, device: Any, size: int | None = None) -> None:
    wp.load_module(module, device=device, block_dim=1 if device.is_cpu else size)


def _is_cached(module: Any, size: int | None, device: Any) -> bool:
    """Whether a module's binary is there; asking hashes what it is made of, which loading needs anyway."""
    name = module.get_module_identifier(1 if device.is_cpu else size)
    return bool(wp.config.cache_kernels) and (Path(wp.config.kernel_cache_dir) / name).is_dir()


class _Headers:
    """Warp's headers, parsed once for all threads and kept for the next process.

    Clang itself sees to it that they fit what it compiles, by the files' times and its own flags, and parses them anew
    where they do not. Warp names the file by all flags; those of LLVM say nothing about headers, so that flags which
    differ in them alone share one. Where this Warp keeps or names headers otherwise, each thread parses them.
    """

    def __init__(self, flags: Iterable[str]) -> None:
        """Find what is there, that of the caller's thread too.

        Args:
            flags: Of the modules that will be compiled.
        """
        self._flags = {*flags, str(wp.config.cpu_compiler_flags), _header_flags()}
        self._folder_of_thread = (
            getattr(_runtime(), "get_clang_pch_dir", None) if wp.config.use_precompiled_headers else None
        )
        builtin = Path(wp.__file__).parent / "native" / "builtin.h"
        self._lock = threading.Lock()
        self._first: int | None = None
        self._parsed, self._over = threading.Event(), threading.Event()
        self._watcher: threading.Thread | None = None
        self._threads: set[int] = set()
        if self._folder_of_thread is None or not builtin.is_file():
            self._folder_of_thread = None
            return
        stat = builtin.stat()
        key = f"{wp.__version__} {builtin} {stat.st_mtime_ns} {stat.st_size} {_header_flags()}"
        self._store = Path(wp.config.kernel_cache_dir) / f"headers_{hashlib.sha256(key.encode()).hexdigest()[:16]}"
        folders = getattr(_runtime(), "_pch_dirs", None)
        parsed = folders.get(threading.get_ident()) if isinstance(folders, dict) else None
        if parsed is not None and not _headers_in(self._store):
            _copy_headers(Path(parsed.name), self._store)

    @property
    def store(self) -> Path | None:
        """Folder in which they are kept; None where they are not."""
        return None if self._folder_of_thread is None else self._store

    @property
    def missing(self) -> bool:
        """Whether they can be kept, and nobody has left them."""
        return self._folder_of_thread is not None and not _headers_in(self._store)

    def parse(self, build: Callable[..., None]) -> None:
        """Parse them on this thread, for all others.

        Args:
            build: Warp's function that compiles a file of C++.
        """
        flags = _header_flags()
        with self.shared(flags), tempfile.TemporaryDirectory() as folder:
            source = Path(folder) / "headers.cpp"
            source.write_text('#include "builtin.h"\n', encoding="utf-8")
            kept = self._folder_of_thread() if self._folder_of_thread is not None else None
            target = str(source.with_suffix(".o"))
            build(target, str(source), extra_flags=flags, use_precompiled_headers=True, pch_dir=kept, block_dim=1)
        self.close()
        remove_header_folders([threading.get_ident()])

    @contextlib.contextmanager
    def shared(self, flags: str) -> Any:
        """Around what a thread compiles: it finds the headers if anyone has parsed them, and leaves its own.

        Args:
            flags: Those of the module.
        """
        if self._folder_of_thread is None:
            yield
            return
        own = Path(self._folder_of_thread())
        with self._lock:
            self._threads.add(threading.get_ident())
            first = self._first is None and not _headers_in(own) and not _headers_in(self._store)
            if first:
                self._first = threading.get_ident()
                self._parsing = own
                self._watcher = threading.Thread(target=self._keep, args=(own,), daemon=True)
                self._watcher.start()
        if not first:
            if not _headers_in(own):
                if self._first is not None:
                    self._parsed.wait(_HEADER_WAIT)
                _copy_headers(self._store, own)
            self._rename(own, flags)
        yield

    def _keep(self, own: Path) -> None:
        """Put what the first thread parses where others find it."""
        stop = time.monotonic() + _HEADER_WAIT
        while time.monotonic() < stop and not _headers_in(own) and not self._over.wait(0.02):
            pass
        _copy_headers(own, self._store)
        self._parsed.set()

    def _rename(self, own: Path, flags: str) -> None:
        """Have headers that were parsed with other flags of LLVM found with these."""
        wanted = digest(flags)
        headers = _headers_in(own)
        if any(wanted in path.name for path in headers):
            return
        for other in self._flags:
            if _clang_flags(other) == _clang_flags(flags):
                for path in headers:
                    if digest(other) in path.name:
                        _copy_file(path, own / path.name.replace(digest(other), wanted))

    def close(self) -> None:
        """When the threads are done: remove what Warp keeps for each of them."""
        self._over.set()
        if self._watcher is not None:
            self._watcher.join()
            _copy_headers(self._parsing, self._store)  # on a busy machine they come later than is waited for
        # A thread of somebody else's may have got the identity of one that has ended.
        alive = {thread.ident for thread in threading.enumerate()}
        remove_header_folders(self._threads - alive)
        # What other threads compile is left until the process ends; registered anew, this comes before Warp's own end.
        atexit.unregister(remove_header_folders)
        atexit.register(remove_header_folders)


def remove_header_folders(threads: Iterable[int] | None = None) -> None:
    """Remove the folders in which Warp keeps parsed headers, some megabytes for each thread that ever compiled.

    Warp leaves them to the end of the process, where Python's development mode warns of them.

    Args:
        threads: Their identities; None means all.
    """
    runtime = _runtime()
    folders, lock = getattr(runtime, "_pch_dirs", None), getattr(runtime, "_pch_dirs_lock", None)
    if not isinstance(folders, dict) or lock is None:
        return
    with lock:
        for thread in list(folders) if threads is None else threads:
            folder = folders.pop(thread, None)
            if folder is not None:
                with contextlib.suppress(OSError):
                    folder.cleanup()


def _runtime() -> Any:
    """What Warp keeps for the process; None before it is initialised, or where this Warp keeps it elsewhere."""
    return getattr(getattr(getattr(wp, "_src", None), "context", None), "runtime", None)


def _header_flags() -> str:
    """What Clang is called with for headers."""
    return f"{wp.config.cpu_compiler_flags} {_INSTANTIATE}"


def _clang_flags(flags: str) -> list[str]:
    """Flags without those of LLVM and of its passes, and without those that fit any headers."""
    apart = {_INSTANTIATE, *UNCHECKED.split()}
    words = [word for word in flags.split() if not word.startswith("-mllvm=") and word not in apart]
    return [word for word in words if not word.endswith("vectorize")]


def _headers_in(folder: Path) -> list[Path]:
    return list(folder.glob("*.pch"))


def _copy_headers(source: Path, target: Path) -> None:
    """Copy parsed headers; a file appears whole or not at all. A full or foreign disk only costs the time again."""
    with contextlib.suppress(OSError):
        for path in _headers_in(source):
            if not (target / path.name).exists():
                target.mkdir(parents=True, exist_ok=True)
                _copy_file(path, target / path.name)


def _copy_file(source: Path, target: Path) -> None:
    with contextlib.suppress(OSError):
        part = target.with_name(f"{target.name}.{os.getpid()}.{threading.get_ident()}")
        shutil.copyfile(source, part)
        part.replace(target)
