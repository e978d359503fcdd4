"""Photographs of a mirror ball at several exposures."""
