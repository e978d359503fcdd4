"""Keeping threads off a device while another one needs it for itself."""

from __future__ import annotations

import threading
from types import SimpleNamespace

from warp_ar.device import exclusive


def held_by_another(device: SimpleNamespace) -> bool:
    """Whether another thread can enter while this one is inside."""
    entered = threading.Event()

    def enter() -> None:
        with exclusive(device):
            entered.set()

    with exclusive(device), exclusive(device):  # twice: a pipeline that builds a scheduler enters again
        thread = threading.Thread(target=enter)
        thread.start()
        held = not entered.wait(0.2)
    thread.join()
    assert entered.is_set()
    return held


def test_one_thread_at_a_time_on_cuda_and_all_on_cpu() -> None:
    assert held_by_another(SimpleNamespace(is_cuda=True))
    assert not held_by_another(SimpleNamespace(is_cuda=False))
