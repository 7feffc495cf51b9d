"""How alike masks and frames are, and how sure one can be of it."""
