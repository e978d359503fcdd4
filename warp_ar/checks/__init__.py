"""Checks of a set-up, in words."""
