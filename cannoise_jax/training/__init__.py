"""Learning the generator, critic and encoder: data, losses, the step, the loop, checkpoints."""
