"""Power spectra of a blurred picture: of its noise, N, and of its sharp content, S.

The predicted kernels K pass some frequencies and cancel others.  Power where they cancel is noise (of the sensor, the
movie's codec, and errors of the kernels); power where they pass is the sharp picture.  So a fit of |G|² = |K|² S + N
over the tiles, in rings of equal frequency, measures both.  The regularisation is therefore measured, not a constant,
and predicted blur that the picture does not show is fitted as noise and not deblurred.

All values are in grey levels; white noise of standard deviation σ has N = σ².

Blur averages light.  A steep tone curve gives the grey levels of a blurred edge overtones that the light does not
have, and where the kernels cancel these would count as noise.  So the noise's standard deviation, which weighs the data
against the prior, is measured in light, scaled to grey levels by the curve's slope at each tile's mean.

The ring model assumes S to be the same in all directions.  Gratings, brick walls and blinds have their power at few
frequencies of a ring: if these pass and the others are cancelled, S is overestimated at the latter, and noise and
kernel errors are restored as detail.  The fit's misfit detects such pictures; their S is measured per frequency.
"""
