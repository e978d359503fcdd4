"""Mirror ball in the picture: its outline, position, radius, reflectance, and occlusion."""
