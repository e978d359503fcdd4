"""The mirror ball in the picture: its outline, place, radius, reflectance, and what hides it."""
