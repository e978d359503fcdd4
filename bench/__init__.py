"""Benchmarks: ``python -m bench`` lists them, ``python -m bench NAME ...`` runs some, ``python -m bench all`` runs all.

Each ``bench_<stage>.py`` has ``main(device)``; it checks its answers first, then times with ``bench.common`` and prints
JSON lines.
"""
