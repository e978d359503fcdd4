"""Bundled scenes: one TOML file each, with the clips and meshes that they use and the scripts that made them."""
