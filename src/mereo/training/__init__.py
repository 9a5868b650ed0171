"""Dataset, losses, the loop, its directory, and released weights."""
