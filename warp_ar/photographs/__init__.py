"""Photographs of a ball at several exposures."""
