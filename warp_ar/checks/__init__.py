"""Checks of a scene's set-up, with findings as text."""
