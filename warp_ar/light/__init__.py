"""Light of the environment beyond the ball's frames: recovered from surfaces, captured, estimated from cards."""
