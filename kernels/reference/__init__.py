"""The path tracer."""
