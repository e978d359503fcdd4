"""Benchmarks: ``python -m bench`` lists them, ``python -m bench NAME ...`` runs some, ``python -m bench all`` runs all.

Each ``bench_NAME.py`` has a function ``main(device)``, which prints JSON lines. Benchmarks of speed check their results
first, and then time with ``bench.common``.
"""
