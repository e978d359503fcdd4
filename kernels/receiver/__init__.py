"""Kernels of real surfaces (receivers): virtual light, shadows and reflections of virtual objects on them."""
