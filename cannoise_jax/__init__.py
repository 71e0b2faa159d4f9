"""Camera-aware raw noise in JAX: learn it, simulate it, and find what a simulator leaves out."""
