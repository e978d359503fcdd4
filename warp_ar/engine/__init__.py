"""Pipeline that lights frames: planning of stages, their execution, their inputs, and transfers to the device."""
