"""Camera, lens, response and printed card."""
