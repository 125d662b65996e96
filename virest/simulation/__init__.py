"""Captures with known truth: the independent judge.

It shares no physics with the forward model that restoration inverts: row times, orientation, blur, lens inversion and
the exposure curve are written here once more.
"""
