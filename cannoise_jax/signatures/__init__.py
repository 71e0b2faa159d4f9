"""Score statistics, one module per signature: where a mechanism shows, how large, how surprising."""
