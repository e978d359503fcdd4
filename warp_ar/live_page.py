"""Page of ``python -m warp_ar.live``: its scene, its address, and its server, which runs until it is interrupted."""

from __future__ import annotations

import argparse
import asyncio
import functools
import gc
import os
import secrets
import shutil
import signal
import sys
import tempfile
import threading
import webbrowser
from pathlib import Path
from typing import TYPE_CHECKING, Any

from warp_ar.begin import EXIT_INTERRUPTED, EXIT_TERMINATED, importing
from warp_ar.command_line import EXIT_DONE, EXIT_USAGE, Terminated
from warp_ar.errors import UsageError, WarpArError, printable, say
from warp_ar.live_start import say_quick_check, start_device
from warp_ar.scene import Scene, load_scene

if TYPE_CHECKING:
    from warp_ar.viewer.address import Address

DEFAULT_PORT = 8720
PORT_TRIES = 20
CHECKING_S = 10.0
"""Longest wait, in seconds, for the check of the scene when the page ends by itself."""


def _page_scene(options: argparse.Namespace) -> Scene:
    """Return the scene of a page.

    Raises:
        UsageError: An option applies to runs to files only, or has an impossible value.
    """
    for name in ("save_environment", "save_layers", "report", "samples", "error"):
        if getattr(options, name) is not None:
            raise UsageError(f"--{name.replace('_', '-')} needs --headless or --output: the page saves on its own")
    if options.refine_ball:
        raise UsageError("--refine-ball needs --headless or --output; before the page, run warp_ar.calibrate ball")
    if options.token is not None and not (options.token.isascii() and options.token.isalnum()):
        raise UsageError("--token: expected letters and digits, as it is part of an address")
    light = None if options.light == "card" else options.light
    if options.calibration is None and light is None:
        return load_scene(options.scene)
    from warp_ar.session import chosen_scene  # loads Warp; other pages do not wait for that

    return chosen_scene(options.scene, options.source, options.calibration, light, options.light_axes)


def _page_address(options: argparse.Namespace) -> Address:
    """Return the address of the page, with its token and certificate."""
    from warp_ar.viewer.address import EVERYWHERE, LOOPBACK, Address, load_context, make_context, own_address
    from warp_ar.viewer.server import check_origin

    known = options.token is not None or options.host in LOOPBACK
    tls = None
    if options.tls is True:
        tls = make_context((options.host in EVERYWHERE and own_address()) or options.host)
    elif options.tls is not None:
        tls = load_context(Path(options.tls))
    port = DEFAULT_PORT if options.port is None else options.port
    origins = tuple(map(check_origin, options.allow_origin))
    return Address(options.host, port, options.token if known else secrets.token_hex(16), tls, origins)


def _make_page_host(options: argparse.Namespace, scene: Scene, checking: threading.Thread, **callbacks: Any) -> Any:
    """Return a page's host, which loads Warp on its own thread while the page is already served."""
    from warp_ar.device import bound_arenas

    start_device(options.device)
    from warp_ar.viewer.host import Host

    checking.start()  # not during the imports: Python 3.11's parser is not thread-safe
    bound_arenas()
    # Imported modules are exempt from garbage collection, which would delay a frame by a tenth of a second.
    gc.collect()
    gc.freeze()
    host = Host(
        scene,
        source=options.source,
        device=options.device,
        quality=options.quality,
        budget_ms=options.budget_ms,
        frames=options.frames,
        by_card=options.light == "card",
        **callbacks,
    )
    if host.no_camera is not None:
        _say_no_camera(options, host.no_camera.finding.text)
    return host


def _say_no_camera(options: argparse.Namespace, text: str) -> None:
    """Print how to connect a camera other than this machine's; the page goes on."""
    from warp_ar.viewer.address import LOOPBACK

    say(f'{text}; the page runs without it: press "My camera" there for the camera of the browser\'s machine')
    if options.host in LOOPBACK:
        say(f"for a phone's camera: python -m warp_ar.live {printable(options.scene)} --host 0.0.0.0 --tls")
    elif not options.tls:
        say("browsers allow their cameras to pages of other machines only over TLS: start with --tls too")


def serve_page(options: argparse.Namespace) -> int:
    """Serve the page until Ctrl-C or until ``--frames`` frames have been lit."""
    # Imported here: runs to files do not wait for the web server to load.
    with importing():
        import segno

        from warp_ar.viewer.address import LOOPBACK
        from warp_ar.viewer.server import Server

    scene = _page_scene(options)
    address = _page_address(options)
    # The check runs concurrently with the page.
    checking = threading.Thread(target=say_quick_check, args=(options, scene), daemon=True)

    def ready(address: Address) -> None:
        print(f"warp_ar: {printable(scene.name)} is at {address.url} (Ctrl-C ends it)", flush=True)
        if (outside := address.outside_url) is not None:
            print(f"warp_ar: from other machines, {outside}", flush=True)
            if sys.stdout.isatty():  # for a phone's camera
                segno.make_qr(outside).terminal(compact=True)
        if not options.no_browser and options.host in LOOPBACK and _has_display():
            webbrowser.open(address.url)

    # A shell starts background processes with SIGINT ignored; here it is the only way to end.
    signal.signal(signal.SIGINT, signal.default_int_handler)
    server = Server(functools.partial(_make_page_host, options, scene, checking), address)
    code, before = EXIT_DONE, tempfile.tempdir
    # Parent of all temporary folders of this run, including those of Warp's compiling threads.
    tempfile.tempdir = folder = tempfile.mkdtemp(prefix="warp_ar_page_")
    try:
        asyncio.run(server.serve(ready, tries=PORT_TRIES if options.port is None else 1))
    except KeyboardInterrupt as error:
        code = EXIT_TERMINATED if isinstance(error, Terminated) else EXIT_INTERRUPTED
    except WarpArError as error:
        if server.ended:
            raise
        say(error)
        code = EXIT_USAGE
    finally:
        tempfile.tempdir = before
        shutil.rmtree(folder, ignore_errors=True)
        gc.unfreeze()  # restore garbage collection of all objects for the caller
    interrupted = code in (EXIT_INTERRUPTED, EXIT_TERMINATED)
    if checking.ident is not None:
        checking.join(0.0 if interrupted else CHECKING_S)
    if not server.ended or interrupted or checking.is_alive():
        # A reference frame, a kernel's compilation or the check of the scene takes seconds and cannot be interrupted.
        # Python would wait for its thread, or end it within native code, which aborts the process. All files are closed
        # and temporary folders removed by now.
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(code)
    return code


def _has_display() -> bool:
    """Return True if a browser can open a window here."""
    return sys.platform in ("win32", "darwin") or bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))
