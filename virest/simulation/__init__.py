"""Synthetic captures with known ground truth: an independent check on restoration.

The simulator shares no physics with the forward model that restoration inverts.  Row times, orientation, blur, lens
inversion and the response curve are implemented here a second time.
"""
