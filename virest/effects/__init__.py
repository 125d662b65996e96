"""One table of everything in a camera profile that may be off: what it is called, how it is fitted, where it shows."""
