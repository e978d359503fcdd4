"""What is known of the environment's light beyond what the ball shows."""
