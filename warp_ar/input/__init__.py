"""Camera frames and what is read off them before light is: sources, markers, exposures, the ball in the picture."""
