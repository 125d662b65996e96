"""How good is it?  Pictures against their truth, and against other methods given the same advantages."""
