"""Fit the phone: what its pictures say about its response curve and its geometry."""
