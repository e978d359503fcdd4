"""Rays against shapes and meshes, and how their directions are drawn."""
